"""Measures the speed of a simulated study, compared with real time and with scipy's `solve_ivp` in a loop.

The study has 200 delays by 200 gains, 10 s each at a step of 20 ms: 40,000 closed loops of the arm with its registers,
on all cores. The peer is a simple implementation: for each run and step one `solve_ivp` call over 20 ms with constant
torque, with the same controller, delay and registers. A few of its runs are timed on one core; the time of all is
extrapolated.
"""

import statistics
import sys
import time
from pathlib import Path

import numpy as np
from harness import Report, progress, run
from scipy.integrate import solve_ivp

from hilrig_sim.arm.dynamics import forward_dynamics
from hilrig_study.controllers.control_laws import LawController, Measurement
from hilrig_study.simulation import quantization
from hilrig_study.simulation.timing import NO_POLL, timeline
from hilrig_study.study_config import AxisConfig, StudyConfig
from hilrig_study.sweep import all_cells, run_cells, sweep

PEER_RUNS = ((20.0, 0.3), (60.0, 0.4), (120.0, 0.2))
"""Delays, ms, and gains of the runs that are timed with `solve_ivp`."""


def study_of(side: int) -> StudyConfig:
    """Return a study of `side` delays by `side` gains."""
    return StudyConfig(
        x=AxisConfig(what="delay_ms", range=(0.0, 200.0), count=side),
        y=AxisConfig(what="gain", range=(0.05, 1.5), count=side),
    )


def run_solve_ivp(study: StudyConfig, delay_ms: float, gain: float) -> tuple[float, np.ndarray]:
    """Simulate one run with `solve_ivp`; return the time that it takes, s, and the final joint positions."""
    timing, rig, plant_model, scenario = study.loop.timing(), study.rig(), study.linear_plant(), study.task.scenario()
    ticks = round(study.loop.duration_s * 1e9 / timing.step_ns)
    line = timeline(timing, ticks, command_delay_ns=round(delay_ms * 1e6))
    controller = study.controllers[0].build(rig, plant_model, timing.period_ns * 1e-9, np.array([gain]))
    assert isinstance(controller, LawController)
    memory = controller.start(1)
    state = np.concatenate([scenario.start, np.zeros(4)])
    commands: list[np.ndarray] = []
    read_positions = np.empty((ticks, 4))
    begin = time.perf_counter()
    for tick in range(ticks):
        read_positions[tick] = quantization.position(state[:4, np.newaxis])[:, 0]
        effort = np.array(plant_model.holding) if line.in_force[tick] == NO_POLL else commands[line.in_force[tick]]
        now = np.array([line.poll_ns[tick] * 1e-9])
        known = read_positions[line.basis[tick], :, np.newaxis]
        given, memory = controller.law(memory, Measurement(now, known, scenario.goal(now), np.zeros(1)))
        commands.append(quantization.effort(given)[:, 0])

        def rates(_: float, y: np.ndarray, tau: np.ndarray = effort) -> np.ndarray:
            return np.concatenate([y[4:], forward_dynamics(rig.arm, y[:4], y[4:], tau)])

        state = solve_ivp(rates, (0.0, timing.step_ns * 1e-9), state, rtol=1e-6, atol=1e-9).y[:, -1]
    return time.perf_counter() - begin, state[:4]


def measure(report: Report, quick: bool) -> None:
    """Time the sweep, one batch and some runs of the peer."""
    side = 40 if quick else 200
    study = study_of(side)
    seconds = []
    for number in range(1 if quick else 3):
        progress(f"{side} x {side}, simulation, run {number + 1}")
        swept = sweep(study, Path(), lambda _: None, theory=False)
        seconds.append(swept.seconds)
    simulation_s = report.add(f"{side} x {side}, 10 s each", "simulation", statistics.median(seconds), "s")
    runs = side * side
    report.add(f"{side} x {side}, 10 s each", "per run", simulation_s / runs * 1e3, "ms")
    speedup = report.add("compared with real time", "speedup", runs * study.loop.duration_s / simulation_s, "times")
    progress("with theory")
    both = sweep(study, Path(), lambda _: None)
    report.add(f"{side} x {side}, with theory", "simulation and theory", both.seconds, "s")
    cells = all_cells(study)[:1000]
    begin = time.perf_counter()
    run_cells(study, cells)
    report.add("one batch of 1,000 on one core", "per run", time.perf_counter() - begin, "ms")
    peers = []
    for delay_ms, gain in PEER_RUNS[: 1 if quick else None]:
        progress(f"solve_ivp: delay {delay_ms:g} ms, gain {gain:g}")
        peer_s, end = run_solve_ivp(study, delay_ms, gain)
        peers.append(peer_s)
        cell = cells[:1].copy()
        cell["delay_ms"], cell["gain"] = delay_ms, gain
        _, outcome = run_cells(study, cell, keep=True)
        difference = np.degrees(np.abs(outcome.positions[-1, :2, 0] - end[:2]).max())
        report.add(f"solve_ivp, delay {delay_ms:g} ms, gain {gain:g}", "per run", peer_s * 1e3, "ms")
        report.add(
            f"solve_ivp, delay {delay_ms:g} ms, gain {gain:g}", "difference of the final positions", difference, "°"
        )
    peer = statistics.median(peers)
    report.add("solve_ivp in a loop, one core", f"{side} x {side}, extrapolated", peer * runs, "s")
    if not quick:
        report.require("200 x 200 sweep, 10 s each", simulation_s, "<=", 60, "s")
    report.require("speedup over real time", speedup, ">=", 5000 if not quick else 500, "times")
    report.require(
        "speedup over solve_ivp in a loop on one core",
        peer * runs / simulation_s,
        ">=",
        300 if not quick else 30,
        "times",
    )
    report.add_note(
        "The sweep uses all cores in spawned processes; solve_ivp runs on one core, one run after the other."
    )


if __name__ == "__main__":
    sys.exit(run(measure, "How fast is a simulated study, compared with real time and with solve_ivp in a loop?"))
