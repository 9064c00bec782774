"""Measures the CPU time of a plant step for 1 to 1,000 rigs, compared with MuJoCo and Pinocchio.

All engines simulate the same arm from the same URDF: hilrig's plant with stops, contacts and parts
(Runge–Kutta–Fehlberg, six evaluations per step); MuJoCo's `mj_step` (RK4, four evaluations) called in a Python loop,
and its `rollout` on one thread; Pinocchio's `aba`, one evaluation of the forward dynamics.
"""

import statistics
import sys
import time
from collections.abc import Callable

import mujoco
import numpy as np
import pinocchio
from harness import Report, progress, rigs_text, run
from mujoco import rollout

from hilrig_runtime.config.lab import LabConfig
from hilrig_sim.arm.model import GRAVITY, RigParameters
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant

COUNTS = (1, 16, 256, 1000)
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


def plant_us(rig: RigParameters, count: int, seconds: float, *, on_the_table: bool = False) -> float:
    """Return the CPU time of one step of `count` rigs, µs, with the tool in the air or dragged over the table."""
    plant = Plant([rig] * count)
    rng = np.random.default_rng(1)
    magnet = np.zeros(count, dtype=np.bool_)
    # Periodic efforts keep the arms away from their stops for any duration.
    phase = np.linspace(0, 2 * np.pi, 50, endpoint=False)[:, np.newaxis, np.newaxis]
    efforts = rng.uniform(0.2, 1.0, (4, count)) * np.cos(phase + rng.uniform(0, 2 * np.pi, (4, count)))
    efforts[:, 2] *= 0.2
    efforts[:, 3] *= 0.02
    if not on_the_table:
        efforts[:, 2] -= rig.arm.masses[2] * GRAVITY
        for index in range(count):
            plant.set_state(index, (0.3, 0.8, 0.05, 0.0), (0.0, 0.0, 0.0, 0.0))
    for tick in range(40):
        plant.step(efforts[tick], magnet)

    def steps() -> None:
        nonlocal tick
        for _ in range(10):
            tick += 1
            plant.step(efforts[tick % 50], magnet)

    return median_us(steps, 10, seconds)


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
    """Time the steps of all engines."""
    lab = LabConfig()
    rig = rig_parameters(lab, lab.rigs[0])
    seconds = 0.3 if quick else 3.0
    hilrig_us: dict[int, float] = {}
    mj_step_us: dict[int, float] = {}
    for count in COUNTS:
        rigs = rigs_text(count)
        progress(rigs)
        hilrig_us[count] = report.add(f"hilrig, {rigs}", "step", plant_us(rig, count, seconds), "µs")
        report.add(f"hilrig, {rigs}", "step, per rig", hilrig_us[count] / count, "µs")
        dragged = plant_us(rig, count, seconds, on_the_table=True)
        report.add(f"hilrig, {rigs}, tool on the table", "step", dragged, "µs")
        peer = MuJoCo(rig, count)
        mj_step_us[count] = report.add(f"mj_step from Python, {rigs}", "step", peer.step_us(seconds), "µs")
        report.add(f"mujoco.rollout, {rigs}", "step", peer.rollout_us(seconds), "µs")
    aba = report.add("Pinocchio aba, 1 rig", "evaluation", aba_us(rig, seconds), "µs")
    report.add("Pinocchio aba, 1 rig", f"{EVALUATIONS} evaluations", EVALUATIONS * aba, "µs")
    report.require("step of one rig", hilrig_us[1], "<=", 250, "µs")
    report.require("step of 1,000 rigs, per rig", hilrig_us[1000] / 1000, "<=", 1, "µs")
    report.require("throughput with 1,000 rigs, ratio to mj_step", mj_step_us[1000] / hilrig_us[1000], ">=", 8, "times")
    report.add_note(
        "hilrig's plant uses numpy only: the call overhead dominates for one rig and is shared by many rigs."
    )


if __name__ == "__main__":
    sys.exit(run(measure, "How much CPU time does a plant step need, compared with MuJoCo and Pinocchio?"))
