"""Measures accuracy and CPU time of a plant step for 1 to 1,000 rigs, compared with a reference, MuJoCo and Pinocchio.

Accuracy: random efforts over the whole range of the torque registers, each step from the same state as the event-driven
reference (scipy's DOP853 with root finding), with automatic sub-steps and with one step of Runge–Kutta–Fehlberg. Cost:
the same steps of both, alternating in one run.

All engines simulate the same arm from the same URDF: hilrig's plant with stops, contacts and parts
(Runge–Kutta–Fehlberg, six evaluations per step); MuJoCo's `mj_step` (RK4, four evaluations) called in a Python loop,
and its `rollout` on one thread; Pinocchio's `aba`, one evaluation of the forward dynamics.
"""

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio
from harness import HERE, Report, progress, rigs_text, run
from mujoco import rollout

from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.rate import Rate
from hilrig_sim.arm.model import GRAVITY, LARGEST_REGISTER_FORCE, RigParameters
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant

sys.path.append(str(HERE.parent / "tests"))
from support.reference_plant import ReferenceArm

COUNTS = (1, 16, 256, 1000)
JUDGED_COUNTS = (1, 1000)
EVALUATIONS = 6


def median_us(work: Callable[[], None], per_call: int, seconds: float, runs: int = 7) -> float:
    """Return the CPU time of one step, µs, as the median of several runs.

    `work` executes `per_call` steps on this thread. CPU time is used because other processes don't affect it.
    """
    work()
    times = []
    for _ in range(runs):
        done, begin = 0, time.thread_time()
        while (spent := time.thread_time() - begin) < seconds / runs or not done:
            work()
            done += per_call
        times.append(spent / done * 1e6 if done else 0.0)
    return statistics.median(times)


class Stepping:
    """A plant of `count` rigs under periodic or random efforts: in the air, on the table, or at the largest torques."""

    def __init__(self, rig: RigParameters, count: int, where: str) -> None:
        self.plant = Plant([rig] * count)
        rng = np.random.default_rng(1)
        self.magnet = np.zeros(count, dtype=np.bool_)
        # Periodic efforts keep the arms away from their stops for any duration.
        phase = np.linspace(0, 2 * np.pi, 50, endpoint=False)[:, np.newaxis, np.newaxis]
        efforts = rng.uniform(0.2, 1.0, (4, count)) * np.cos(phase + rng.uniform(0, 2 * np.pi, (4, count)))
        efforts[:, 2] *= 0.2
        efforts[:, 3] *= 0.02
        if where == AIR:
            efforts[:, 2] -= rig.arm.masses[2] * GRAVITY
            for index in range(count):
                self.plant.set_state(index, (0.3, 0.8, 0.05, 0.0), (0.0, 0.0, 0.0, 0.0))
        elif where == FULL:
            efforts = rng.uniform(-LARGEST_REGISTER_FORCE, LARGEST_REGISTER_FORCE, (max(50, 2000 // count), 4, count))
        self.efforts = efforts
        self._tick = 0
        self.steps(40)

    def steps(self, number: int) -> None:
        """Make steps."""
        for _ in range(number):
            self._tick += 1
            self.plant.step(self.efforts[self._tick % len(self.efforts)], self.magnet)


AIR, TABLE, FULL = "", ", tool on the table", ", full-range torques"


def step_times_us(rigs: Sequence[RigParameters], count: int, seconds: float, where: str) -> list[float]:
    """Return the CPU time of one step of `count` rigs for each of the parameters, µs, measured alternately."""
    with np.errstate(all="ignore"):
        cases = [Stepping(rig, count, where) for rig in rigs]
    times: list[list[float]] = [[] for _ in cases]
    number = max(5, 1000 // count)
    with np.errstate(all="ignore"):
        begin = time.monotonic()
        while time.monotonic() - begin < seconds or len(times[0]) < 5:
            for case, measured in zip(cases, times, strict=True):
                start = time.thread_time()
                case.steps(number)
                measured.append((time.thread_time() - start) / number * 1e6)
    return [statistics.median(measured) for measured in times]


def tick_ms(count: int, seconds: float) -> float:
    """Return the CPU time of a tick of the simulation service with `count` moving rigs, ms."""
    lab = LabConfig(rigs=tuple(RigSettings(name=f"rig{number}") for number in range(count)))
    clock = ManualClock()
    service = Service("sim", lab, MemoryBus(MemoryHub()), clock=clock)
    simulation = Simulation(service, [rig_parameters(lab, rig) for rig in lab.rigs])
    rate = Rate(lab.sim.step_ns, clock)
    moving = Stepping(rig_parameters(lab, lab.rigs[0]), count, AIR)
    plant = simulation._plant
    plant.copy_state_from(moving.plant, range(count), range(count))

    def ticks() -> None:
        for effort in moving.efforts:
            simulation._effort[:] = effort
            simulation.pre_encode(rate.next_ns)
            simulation.tick(rate.wait())

    return median_us(ticks, len(moving.efforts), seconds) / 1e3


def accuracy(report: Report, rig: RigParameters, once: RigParameters, steps: int) -> None:
    """Compare steps of the whole range of torques with the event-driven reference."""
    count = 50
    automatic, single, reference = Plant([rig] * count), Plant([once] * count), ReferenceArm(rig.arm)
    rng = np.random.default_rng(2)
    magnet = np.zeros(count, dtype=np.bool_)
    position_error, speed_error, substeps = np.zeros((2, 3)), np.zeros(2), []
    compared = -20 * count
    while compared < steps:
        limit = rng.choice((1.0, 8.0, 16.0, LARGEST_REGISTER_FORCE), count)
        efforts = rng.uniform(-limit, limit, (4, count))
        bang = rng.random(count) < 0.5
        efforts[:, bang] = np.sign(efforts[:, bang]) * limit[bang]
        q0, v0 = automatic.position.copy(), automatic.velocity.copy()
        with np.errstate(all="ignore"):
            for index in range(count):
                single.set_state(index, q0[:, index].tolist(), v0[:, index].tolist())
            single.step(efforts, magnet)
            automatic.step(efforts, magnet)
        substeps.append(automatic.substeps.mean())
        for index in range(count if compared >= 0 else 0):
            q, v = reference.step(q0[:, index], v0[:, index], efforts[:, index], rig.sim.step)
            speed = max(np.abs(v0[:2, index]).max(), np.abs(v[:2]).max(), 0.01)
            for number, plant in enumerate((automatic, single)):
                off = np.abs(plant.position[:, index] - q)
                units = np.degrees(off[:2].max()), 1e3 * off[2], np.degrees(off[3])
                position_error[number] = np.maximum(position_error[number], units)
                off_speed = np.abs(plant.velocity[:2, index] - v[:2]).max() / speed
                speed_error[number] = max(speed_error[number], off_speed)
        compared += count
        progress(f"accuracy: {max(compared, 0)} steps")
    for number, case in enumerate(("automatic sub-steps", "one sub-step")):
        of = f"{case}, {compared:,} random steps"
        for joint, unit, value in zip(
            ("joints 1 and 2", "joint 3", "joint 4"), "°m°", position_error[number], strict=True
        ):
            report.add(of, f"largest position error of {joint}", value, "mm" if unit == "m" else "°")
        report.add(of, "largest speed error of joints 1 and 2", 100 * speed_error[number], "%")
    report.add("automatic sub-steps, random steps", "mean number of sub-steps", float(np.mean(substeps)), "")
    report.require("position error of a step, joints 1, 2 and 4", max(position_error[0][[0, 2]]), "<=", 0.1, "°")
    report.require("position error of a step, joint 3", position_error[0][1], "<=", 0.1, "mm")
    report.require("speed error of a step", 100 * speed_error[0], "<=", 1, "%")


def divergence(report: Report, rig: RigParameters, hours: float) -> None:
    """Simulate random torques of the whole range, and count rigs that diverge and steps that are inaccurate."""
    count = 1000
    plant, rng = Plant([rig] * count), np.random.default_rng(3)
    magnet = np.zeros(count, dtype=np.bool_)
    steps = round(hours * 3600 / rig.sim.step / count)
    diverged, inaccurate, fastest, most = 0, 0, 0.0, 0
    for step in range(steps):
        efforts = rng.uniform(-LARGEST_REGISTER_FORCE, LARGEST_REGISTER_FORCE, (4, count))
        if step % 2:
            efforts = np.sign(efforts) * LARGEST_REGISTER_FORCE
        plant.step(efforts, magnet)
        diverged += int(np.count_nonzero(~np.isfinite(plant.velocity).all(axis=0)))
        inaccurate += plant.is_inaccurate()
        fastest = max(fastest, float(np.abs(plant.velocity[:2]).max()))
        most = max(most, int(plant.substeps.max()))
        if step % 100 == 0:
            progress(f"divergence: {step} of {steps} steps")
    case = f"{hours:g} rig-hours of full-range torques"
    report.add(case, "fastest joint 1 or 2", fastest, "rad/s")
    report.add(case, "largest number of sub-steps", most, "")
    report.require(f"diverged rigs in {case}", diverged, "<=", 0)
    report.require(f"inaccurate steps in {case}", inaccurate, "<=", 0)


class MuJoCo:
    """The arm simulated by MuJoCo."""

    def __init__(self, rig: RigParameters, count: int) -> None:
        self.model = mujoco.MjModel.from_xml_string(urdf(rig))
        self.model.opt.timestep = rig.sim.step
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.model.opt.gravity[:] = (0, 0, -GRAVITY)
        self.model.dof_armature[3] = rig.arm.j4
        rng = np.random.default_rng(1)
        self.efforts = rng.uniform(-0.5, 0.5, (count, 4)) * (1, 1, 0, 0.02) - (0, 0, rig.arm.masses[2] * GRAVITY, 0)
        self.datas = [mujoco.MjData(self.model) for _ in range(count)]
        for data, effort in zip(self.datas, self.efforts, strict=True):
            data.qpos[2] = 0.1
            data.qfrc_applied[:] = effort

    def step_us(self, seconds: float) -> float:
        """Return the CPU time of one `mj_step` of each arm, called in a Python loop, µs."""
        model, step = self.model, mujoco.mj_step

        def steps() -> None:
            for data in self.datas:
                step(model, data)

        return median_us(steps, 1, seconds)

    def rollout_us(self, seconds: float, steps: int = 20) -> float:
        """Return the CPU time of one step of each arm by `rollout`, which loops in C, µs."""
        count = len(self.datas)
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        initial = np.zeros((count, size))
        for row, data in zip(initial, self.datas, strict=True):
            mujoco.mj_getState(self.model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        control = np.repeat(self.efforts[:, np.newaxis, :], steps, axis=1)
        data = mujoco.MjData(self.model)
        spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)

        def once() -> None:
            rollout.rollout(self.model, data, initial, control, control_spec=spec, nstep=steps)

        return median_us(once, steps, seconds)


def aba_us(rig: RigParameters, seconds: float) -> float:
    """Return the CPU time of one forward dynamics evaluation by Pinocchio, µs."""
    model = pinocchio.buildModelFromXML(urdf(rig))
    model.armature = np.array([0.0, 0.0, 0.0, rig.arm.j4])
    data = model.createData()
    rng = np.random.default_rng(1)
    q, v, tau = rng.uniform(-1, 1, (3, 4))

    def evaluations() -> None:
        for _ in range(100):
            pinocchio.aba(model, data, q, v, tau)

    return median_us(evaluations, 100, seconds)


def measure(report: Report, quick: bool) -> None:
    """Measure accuracy, and time the steps of all engines."""
    lab = LabConfig()
    rig = rig_parameters(lab, lab.rigs[0])
    once = replace(rig, sim=replace(rig.sim, substeps=1))
    seconds = 0.3 if quick else 3.0
    nothing_below = replace(rig.scene, table_height=-1.0, parts=(), trays=())
    accuracy(report, replace(rig, scene=nothing_below), replace(once, scene=nothing_below), 200 if quick else 10_000)
    divergence(report, rig, 0.05 if quick else 10.0)
    hilrig_us: dict[int, float] = {}
    mj_step_us: dict[int, float] = {}
    for count in COUNTS:
        rigs = rigs_text(count)
        progress(rigs)
        for where, bound in ((AIR, 2.2), (TABLE, None), (FULL, 5.0)):
            automatic, single = step_times_us((rig, once), count, 2 * seconds, where)
            case = f"hilrig, {rigs}{where}"
            report.add(case, "step, automatic sub-steps", automatic, "µs")
            report.add(case, "step, one sub-step", single, "µs")
            report.add(case, "ratio", automatic / single, "times")
            if bound is not None and count in JUDGED_COUNTS:
                report.require(f"cost of automatic sub-steps, {rigs}{where}", automatic / single, "<=", bound, "times")
            if where == AIR:
                hilrig_us[count] = automatic
        peer = MuJoCo(rig, count)
        mj_step_us[count] = report.add(f"mj_step from Python, {rigs}", "step", peer.step_us(seconds), "µs")
        report.add(f"mujoco.rollout, {rigs}", "step", peer.rollout_us(seconds), "µs")
    aba = report.add("Pinocchio aba, 1 rig", "evaluation", aba_us(rig, seconds), "µs")
    report.add("Pinocchio aba, 1 rig", f"{EVALUATIONS} evaluations", EVALUATIONS * aba, "µs")
    report.require("throughput with 1,000 rigs, ratio to mj_step", mj_step_us[1000] / hilrig_us[1000], ">=", 8, "times")
    report.require("CPU time of a tick of 128 rigs", tick_ms(128, seconds), "<=", 5, "ms")
    report.add_note(
        "hilrig's plant uses numpy only: the call overhead dominates for one rig and is shared by many rigs."
    )


QUESTION = "How accurate is a plant step, and how much CPU time does it need, compared with MuJoCo and Pinocchio?"

if __name__ == "__main__":
    sys.exit(run(measure, QUESTION))
