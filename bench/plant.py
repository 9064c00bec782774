"""What does a step of the plant cost, for one rig and for a thousand, next to engines that others wrote?

The same arm, from the same URDF: hilrig's plant with its stops, contacts and parts (Runge–Kutta–Fehlberg, six
evaluations a step); MuJoCo's `mj_step` (RK4, four evaluations) looped from Python, and its `rollout` on one thread;
Pinocchio's `aba`, one evaluation, which is what a step of one's own would be made of.
"""

import statistics
import sys
import time
from collections.abc import Callable

import mujoco
import numpy as np
import pinocchio
from harness import Report, progress, run
from mujoco import rollout

from hilrig_runtime.config.lab import LabConfig
from hilrig_sim.arm.model import GRAVITY, RigParameters
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant

COUNTS = (1, 16, 256, 1000)
EVALUATIONS = 6


def median_us(work: Callable[[], None], per_call: int, seconds: float, runs: int = 7) -> float:
    """Median over runs of one call's processor time, µs; `work` is `per_call` calls' worth, all on this thread.

    Processor time, for what else runs on the machine is not the question.
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
    """One step of `count` rigs, µs: moving freely, or with the tool dragged over the table."""
    plant = Plant([rig] * count)
    rng = np.random.default_rng(1)
    magnet = np.zeros(count, dtype=np.bool_)
    # To and fro, so that the arms stay clear of their stops however long it is measured.
    phase = np.linspace(0, 2 * np.pi, 50, endpoint=False)[:, np.newaxis, np.newaxis]
    efforts = rng.uniform(0.2, 1.0, (4, count)) * np.cos(phase + rng.uniform(0, 2 * np.pi, (4, count)))
    efforts[:, 2] *= 0.2
    efforts[:, 3] *= 0.02
    if not on_the_table:
        efforts[:, 2] -= rig.arm.masses[2] * GRAVITY
        for index in range(count):
            plant.set_state(index, (0.3, 0.8, 0.05, 0.0), (0.0, 0.0, 0.0, 0.0))
    for turn in range(40):
        plant.step(efforts[turn], magnet)

    def steps() -> None:
        nonlocal turn
        for _ in range(10):
            turn += 1
            plant.step(efforts[turn % 50], magnet)

    return median_us(steps, 10, seconds)


class MuJoCo:
    """The same arm in MuJoCo."""

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
        """One `mj_step` of each, looped from Python, µs."""
        model, step = self.model, mujoco.mj_step

        def steps() -> None:
            for data in self.datas:
                step(model, data)

        return median_us(steps, 1, seconds)

    def rollout_us(self, seconds: float, steps: int = 20) -> float:
        """One step of each by `rollout`, which loops in C, µs."""
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
    """One forward dynamics by Pinocchio, µs."""
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
    lab = LabConfig()
    rig = rig_parameters(lab, lab.rigs[0])
    seconds = 0.3 if quick else 3.0
    ours: dict[int, float] = {}
    mj_step: dict[int, float] = {}
    for count in COUNTS:
        progress(f"{count} rigs")
        ours[count] = report.add(f"hilrig, {count} rigs", "step", plant_us(rig, count, seconds), "µs")
        report.add(f"hilrig, {count} rigs", "step a rig", ours[count] / count, "µs")
        dragged = plant_us(rig, count, seconds, on_the_table=True)
        report.add(f"hilrig, {count} rigs, tool on the table", "step", dragged, "µs")
        peer = MuJoCo(rig, count)
        mj_step[count] = report.add(f"mj_step from Python, {count} rigs", "step", peer.step_us(seconds), "µs")
        report.add(f"mujoco.rollout, {count} rigs", "step", peer.rollout_us(seconds), "µs")
    aba = report.add("Pinocchio aba, 1 rig", "evaluation", aba_us(rig, seconds), "µs")
    report.add("Pinocchio aba, 1 rig", f"{EVALUATIONS} evaluations", EVALUATIONS * aba, "µs")
    report.bar("step of one rig", ours[1], "<=", 250, "µs")
    report.bar("step of 1,000 rigs, each", ours[1000] / 1000, "<=", 1, "µs")
    report.bar("throughput at 1,000 rigs, over mj_step's", mj_step[1000] / ours[1000], ">=", 8, "times")
    report.say("hilrig's step is in numpy alone; a single rig pays for its calls, a thousand share them.")


if __name__ == "__main__":
    sys.exit(run(measure, "What does a step of the plant cost, next to MuJoCo and Pinocchio?"))
