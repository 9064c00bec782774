"""How fast is a study in virtual time, next to the clock and to the same study with scipy's `solve_ivp` in a loop?

200 delays by 200 gains, 10 s each at a step of 20 ms: 40,000 closed loops of the arm with its registers, on all cores.
The peer does what one writes first: for each run and step a `solve_ivp` over 20 ms under the held torque, with the same
controller, delay and registers; a few runs are timed, on one core, and the rest is a multiplication.
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

PEERS = ((20.0, 0.3), (60.0, 0.4), (120.0, 0.2))
"""Delays, ms, and gains of the runs that are timed with solve_ivp."""


def study_of(side: int) -> StudyConfig:
    return StudyConfig(
        x=AxisConfig(what="delay_ms", range=(0.0, 200.0), count=side),
        y=AxisConfig(what="gain", range=(0.05, 1.5), count=side),
    )


def one_by_solve_ivp(study: StudyConfig, delay_ms: float, gain: float) -> tuple[float, np.ndarray]:
    """Seconds that one run takes, and where the arm is at its end."""
    timing, rig, plant_model, scenario = study.loop.timing(), study.rig(), study.linear_plant(), study.task.scenario()
    ticks = round(study.loop.duration_s * 1e9 / timing.step_ns)
    line = timeline(timing, ticks, command_delay_ns=round(delay_ms * 1e6))
    controller = study.controllers[0].build(rig, plant_model, timing.period_ns * 1e-9, np.array([gain]))
    assert isinstance(controller, LawController)
    memory = controller.start(1)
    state = np.concatenate([scenario.start, np.zeros(4)])
    commands: list[np.ndarray] = []
    seen = np.empty((ticks, 4))
    begin = time.perf_counter()
    for tick in range(ticks):
        seen[tick] = quantization.position(state[:4, np.newaxis])[:, 0]
        effort = np.array(plant_model.holding) if line.in_force[tick] == NO_POLL else commands[line.in_force[tick]]
        now = np.array([line.poll_ns[tick] * 1e-9])
        known = seen[line.basis[tick], :, np.newaxis]
        given, memory = controller.law(memory, Measurement(now, known, scenario.goal(now), np.zeros(1)))
        commands.append(quantization.effort(given)[:, 0])

        def rates(_: float, y: np.ndarray, tau: np.ndarray = effort) -> np.ndarray:
            return np.concatenate([y[4:], forward_dynamics(rig.arm, y[:4], y[4:], tau)])

        state = solve_ivp(rates, (0.0, timing.step_ns * 1e-9), state, rtol=1e-6, atol=1e-9).y[:, -1]
    return time.perf_counter() - begin, state[:4]


def measure(report: Report, quick: bool) -> None:
    side = 40 if quick else 200
    study = study_of(side)
    seconds = []
    for number in range(1 if quick else 3):
        progress(f"{side} x {side} in virtual time, run {number + 1}")
        swept = sweep(study, Path(), lambda _: None, theory=False)
        seconds.append(swept.seconds)
    took = report.add(f"{side} x {side}, 10 s each", "virtual time", statistics.median(seconds), "s")
    runs = side * side
    report.add(f"{side} x {side}, 10 s each", "a run", took / runs * 1e3, "ms")
    real = report.add("against the clock", "times real time", runs * study.loop.duration_s / took, "times")
    progress("with theory")
    both = sweep(study, Path(), lambda _: None)
    report.add(f"{side} x {side}, with theory", "virtual time and theory", both.seconds, "s")
    cells = all_cells(study)[:1000]
    begin = time.perf_counter()
    run_cells(study, cells)
    report.add("one batch of 1,000 on one core", "a run", time.perf_counter() - begin, "ms")
    peers = []
    for delay_ms, gain in PEERS[: 1 if quick else None]:
        progress(f"solve_ivp: delay {delay_ms:g} ms, gain {gain:g}")
        peer_s, end = one_by_solve_ivp(study, delay_ms, gain)
        peers.append(peer_s)
        mine = cells[:1].copy()
        mine["delay_ms"], mine["gain"] = delay_ms, gain
        _, outcome = run_cells(study, mine, keep=True)
        apart = np.degrees(np.abs(outcome.positions[-1, :2, 0] - end[:2]).max())
        report.add(f"solve_ivp, delay {delay_ms:g} ms, gain {gain:g}", "a run", peer_s * 1e3, "ms")
        report.add(f"solve_ivp, delay {delay_ms:g} ms, gain {gain:g}", "apart at the end", apart, "°")
    peer = statistics.median(peers)
    report.add("solve_ivp in a loop, one core", f"{side} x {side}, by multiplication", peer * runs, "s")
    if not quick:
        report.bar("200 x 200 sweep, 10 s each", took, "<=", 60, "s")
    report.bar("study against the clock", real, ">=", 5000 if not quick else 500, "times")
    report.bar(
        "study against solve_ivp in a loop on one core", peer * runs / took, ">=", 300 if not quick else 30, "times"
    )
    report.say("The sweep uses all cores, spawned; solve_ivp is timed on one, run by run, as a loop over it would be.")


if __name__ == "__main__":
    sys.exit(run(measure, "How fast is a study in virtual time, next to the clock and to solve_ivp in a loop?"))
