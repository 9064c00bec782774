"""Test of feedback: control laws are recognized, torques that do not depend on the positions are not."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from hilrig_replay.analysis.feedback import (
    RoundingGains,
    contains_rounding_errors,
    follows_positions,
    is_restoring_law,
)
from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE, Rows
from hilrig_sim.plant.plant import Plant
from support.recordings import PARAMETERS, REGISTER_SCALE

STEP_S = 0.02
Law = Callable[[float, np.ndarray], np.ndarray]
"""Torques of a time and of the positions in the registers, degrees and mm."""
WEIGHT = np.array([0, 0, -4.905, 0])


def run(law: Law, *, seconds: float = 20.0, poll_steps: int = 1) -> tuple[Rows, Rows]:
    """States and commands of an arm whose torques act one step after the poll."""
    plant = Plant([PARAMETERS])
    plant.position[:, 0] = (0.2, -0.3, 0.05, 0.1)
    states, commands = np.zeros(round(seconds / STEP_S), STATE_DTYPE), []
    torque, magnet = np.zeros((4, 1)), np.zeros(1, np.bool_)
    coming = torque
    for number, state in enumerate(states):
        torque = coming
        state["step"], state["incarnation"] = number + 1, 7
        state["position"] = plant.position[:, 0]
        if number % poll_steps == 0:
            registers = np.rint(plant.position[:, 0] * REGISTER_SCALE * 100) / 100
            effort = np.rint(np.clip(law(number * STEP_S, registers), -32, 32) * 1000) / 1000
            coming = effort.reshape(4, 1)
            command = np.zeros(1, COMMAND_DTYPE)
            command["basis_step"], command["basis_incarnation"] = number + 1, 7
            command["effort"], command["write_arrived_ns"] = effort, round(number * STEP_S * 1e9) + 3_000_000
            commands.append(command)
        plant.step(torque, magnet)
    return states, np.concatenate(commands)


def pd(kp: tuple[float, ...], kd: tuple[float, ...], goal: Callable[[float], np.ndarray], period_s: float) -> Law:
    """A PD law with a filtered difference quotient, as in examples/hold_position.py."""
    before, speed = np.zeros(4), np.zeros(4)
    polled = False

    def law(time_s: float, registers: np.ndarray) -> np.ndarray:
        nonlocal before, speed, polled
        if polled:
            speed = 0.5 * speed + 0.5 * (registers - before) / period_s
        before, polled = registers, True
        return np.array(kp) * (goal(time_s) - registers) - np.array(kd) * speed + WEIGHT

    return law


def poses(time_s: float) -> np.ndarray:
    return np.array([[30, 20, 80, 0], [-20, 45, 120, 30]][int(time_s / 4) % 2])


def hold(time_s: float) -> np.ndarray:
    return np.array([30, -45, 50, 20])


def sine(time_s: float) -> np.ndarray:
    return np.array([30 * np.sin(1.5 * time_s), 15 * np.sin(1.5 * time_s), 80, 10 * np.sin(time_s)])


def moves(time_s: float) -> np.ndarray:
    """S-curves from pose to pose, as in examples/pick_and_place.py."""
    share = min((time_s % 2) / 0.6, 1.0)
    curve = share**3 * (10 - 15 * share + 6 * share**2)
    begin, end = (0, 1) if int(time_s / 2) % 2 == 0 else (1, 0)
    corners = np.array([[30, 20, 80, 0], [-20, 45, 120, 30]])
    return np.asarray(corners[begin] + curve * (corners[end] - corners[begin]))


GAINS = ((0.25, 0.25, 0.03, 0.004), (0.04, 0.03, 0.002, 0.0005))


@pytest.mark.parametrize(("goal", "poll_steps"), [(poses, 1), (poses, 2), (hold, 1), (sine, 2), (moves, 1), (moves, 2)])
def test_recognizes_a_pd_law(goal: Callable[[float], np.ndarray], poll_steps: int) -> None:
    assert follows_positions([run(pd(*GAINS, goal, poll_steps * STEP_S), poll_steps=poll_steps)])


def test_recognizes_a_slow_proportional_law_with_a_moving_goal() -> None:
    law = pd((0.12, 0.12, 0.03, 0.004), (0.0,) * 4, sine, 5 * STEP_S)
    assert follows_positions([run(law, seconds=40.0, poll_steps=5)])


@pytest.mark.parametrize("gain", [0.02, 0.25])
@pytest.mark.parametrize("poll_steps", [1, 5])
def test_recognizes_a_proportional_law_of_one_joint(gain: float, poll_steps: int) -> None:
    def law(time_s: float, registers: np.ndarray) -> np.ndarray:
        return np.array([gain * (30 - registers[0]), 0, -4.905, 0])

    assert follows_positions([run(law, poll_steps=poll_steps)])


SCALE = np.array([1, 0.5, -4.9, 0.05])
RANDOM = np.random.default_rng(1)
OPEN_LOOPS: dict[str, Law] = {
    "zero": lambda *_: np.zeros(4),
    "constant": lambda *_: SCALE,
    "counter": lambda t, _: np.array([0, 0, 0, round(t / STEP_S) % 9 / 1000]),
    "sinusoid": lambda t, _: SCALE * np.sin(t),
    "fast sinusoids": lambda t, _: SCALE * np.sin(np.array([9, 7, 8, 12]) * t),
    "sum of sinusoids": lambda t, _: SCALE * (np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t)),
    "chirp": lambda t, _: SCALE * np.sin(t * t / 4),
    "square": lambda t, _: SCALE * np.sign(np.sin(t)),
    "triangle": lambda t, _: SCALE * np.arcsin(np.sin(t)),
    "trapezoid": lambda t, _: SCALE * np.clip(3 * np.sin(t), -1, 1),
    "ramp": lambda t, _: SCALE * (t % 5) / 5,
    "decay": lambda t, _: SCALE * np.exp(-(t % 5)),
    "random": lambda *_: SCALE * RANDOM.normal(size=4),
    "noisy sinusoid": lambda t, _: SCALE * np.sin(t + 0.01 * RANDOM.normal()),
    "noisy square": lambda t, _: SCALE * np.sign(np.sin(t)) + 0.002 * RANDOM.normal(size=4),
}


@cache
def open_loop(name: str) -> tuple[Rows, Rows]:
    return run(OPEN_LOOPS[name])


@pytest.mark.parametrize("name", OPEN_LOOPS)
def test_torques_of_a_program_without_positions_do_not_follow(name: str) -> None:
    assert not follows_positions([open_loop(name)])


def test_torques_of_another_arm_do_not_follow() -> None:
    states, _ = run(pd(*GAINS, hold, STEP_S))
    _, commands = run(pd(*GAINS, sine, STEP_S))
    assert not follows_positions([(states, commands)])


def test_too_few_commands_show_nothing() -> None:
    assert not follows_positions([])
    states, commands = run(pd(*GAINS, sine, STEP_S), seconds=0.5)
    assert not follows_positions([(states, commands)])
    assert not follows_positions([(states[:0], commands)])


def test_commands_without_a_basis_show_nothing() -> None:
    states, commands = run(pd(*GAINS, sine, STEP_S))
    commands["basis_step"] = 0
    assert not follows_positions([(states, commands)])


def test_each_evidence_is_sufficient() -> None:
    def series(law: Law) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        states, commands = run(law)
        positions = states["position"] * REGISTER_SCALE * 100
        return [(commands["write_arrived_ns"] / 1e9, positions, commands["effort"] * 1e3)]

    filtered = series(pd(*GAINS, sine, STEP_S))
    assert contains_rounding_errors(filtered)
    assert not is_restoring_law(filtered)
    weak = series(pd((0.02, 0.0, 0.0, 0.0), (0.0,) * 4, hold, STEP_S))
    assert is_restoring_law(weak)


def test_noise_is_of_significant_gains_only() -> None:
    gains, statistics = np.zeros((4, 4)), np.zeros((4, 4))
    gains[0], statistics[0] = (0.3, 5.0, -5.0, 0.4), (400.0, 1.5, 1.5, 60.0)
    assert RoundingGains(gains, statistics, np.arange(4.0)).noise == pytest.approx([0.5 / np.sqrt(12), 0, 0, 0])
