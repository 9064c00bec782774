"""Live points of a study: runs a lab with one rig per point, drives each rig, and compares it with its twin."""

import json
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from hilrig_cli.local.demo import free_ports
from hilrig_cli.local.local_lab import POLL_S, running_lab
from hilrig_cli.local.supervisor import Supervisor
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.config.impairment import BernoulliLoss, ConstantDelay, NoLoss, UniformDelay, WayImpairment, Ways
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_study.live.live_loop import RigClient, drive, listen_for_ticks
from hilrig_study.live.twin import compare_with_twins
from hilrig_study.study_config import PointConfig, StudyConfig
from hilrig_study.sweep import cell_at

CLOCK: Final = "clock"
"""Name of the rig without impairment, which the phase of the ticks is measured on."""
_LEAD_NS: Final = 200_000_000
_RECORDED_TIMEOUT_S: Final = 20.0


def run_live_points(study: StudyConfig, folder: Path, out: Path, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Run every live point of a study and compare it with the simulation; return plain values, one entry per point.

    Raises:
        InputError: a point can't be run live.
        OperationError: a lab could not start, or a recording is missing.
    """
    names = [controller.name for controller in study.controllers]
    points = [(point, names.index(point.controller) if point.controller else 0) for point in study.live]
    cells = [cell_at(study, point.x, point.y, number) for point, number in points]
    compared: list[dict[str, Any]] = []
    recordings = out / "recordings"
    shutil.rmtree(recordings, ignore_errors=True)
    for step_ms in sorted({float(cell["step_ms"][0]) for cell in cells}):
        indices = [index for index, cell in enumerate(cells) if cell["step_ms"][0] == step_ms]
        config = out / f"lab-{step_ms:g}ms.toml"
        _write_lab(config, study, step_ms, {f"point{i + 1}": _ways(study, cells[i]) for i in indices}, recordings)
        lab = load_lab(config)
        with running_lab(lab, config, log, threading.Event()) as supervisor:
            for index in indices:
                point, number = points[index]
                log(f"live: {names[number]} at {study.x.label} {point.x:g}, {study.y.label} {point.y:g}")
                run = _run_point(study, folder, lab, f"point{index + 1}", cells[index], supervisor)
                comparison = compare_with_twins(study, cells[index], run, folder)
                compared.append(_describe(point, names[number], run) | comparison.as_dict())
    return compared


def _describe(point: PointConfig, controller: str, run: Run) -> dict[str, Any]:
    return {"x": point.x, "y": point.y, "controller": controller, "recording": str(run.path)}


def _ways(study: StudyConfig, cell: np.ndarray[Any, np.dtype[np.void]]) -> Ways:
    """Impairment of a point: the study's own, or the delay, jitter and loss that the sweep adds.

    Raises:
        InputError: both impair the command link.
    """
    base = study.ways(int(cell["controller"][0]))
    delay_ms, jitter_ms, loss = (float(cell[name][0]) for name in ("delay_ms", "jitter_ms", "loss"))
    if not (delay_ms or jitter_ms or loss):
        return base
    if not base.command.does_nothing:
        raise InputError(
            "live point: the study's impairment and the sweep both impair the command link: remove one of them"
        )
    delay = (
        UniformDelay(low_ms=delay_ms, high_ms=delay_ms + jitter_ms) if jitter_ms else ConstantDelay(delay_ms=delay_ms)
    )
    way = WayImpairment(delay=delay, loss=BernoulliLoss(rate=loss) if loss else NoLoss())
    return base.model_copy(update={"command": way})


def _write_lab(config: Path, study: StudyConfig, step_ms: float, rigs: Mapping[str, Ways], recordings: Path) -> None:
    template = study.lab(step_ms)
    ports = free_ports(5020, len(rigs) + 1)
    lines = [
        "# The lab of a study's live points: one rig per point, and one without impairment.",
        'name = "study"',
        f"sim = {_toml(template.sim.model_dump())}",
        f"edge = {_toml({'first_port': ports, 'session_grace_ms': 0.0})}",
        f"bus = {_toml({'first_port': free_ports(7447, 3)})}",
        f"recorder = {_toml({'folder': str(recordings.resolve())})}",
        f"scene = {_toml({'trays': [], 'parts': []})}",
    ]
    arm = _toml(template.rigs[0].arm.model_dump())
    for name, ways in {CLOCK: Ways(), **rigs}.items():
        impairment = {"seed": study.seed, **ways.model_dump()}
        lines += ["[[rigs]]", f'name = "{name}"', f"arm = {arm}", f"impairment = {_toml(impairment)}"]
    try:
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OperationError(f"{config}: can't be written: {error.strerror}") from error


def _toml(value: Any) -> str:
    """Format a number, string, list or dict as an inline TOML value."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)


def _run_point(
    study: StudyConfig,
    folder: Path,
    lab: LabConfig,
    rig: str,
    cell: np.ndarray[Any, np.dtype[np.void]],
    supervisor: Supervisor,
) -> Run:
    """Drive the rig of a point; return its recording.

    Raises:
        OperationError: the recording is missing.
    """
    timing = study.loop.timing(float(cell["step_ms"][0]), float(cell["poll_ms"][0]))
    gain = np.ascontiguousarray(cell["gain"])
    config = study.controllers[cell["controller"][0]]
    parameters = study.rig(float(cell["step_ms"][0]))
    controller = config.build(parameters, study.near(), timing.period_ns * 1e-9, gain, folder)
    listener, client = RigClient(lab.edge.host, lab.ports[CLOCK]), RigClient(lab.edge.host, lab.ports[rig])
    try:
        tick_ns = listen_for_ticks(listener, timing.step_ns)
        # A state reaches the edge one transport time after its tick; the phase counts from the tick.
        first_ns = tick_ns + timing.phase_ns - timing.transport_ns
        first_ns += -((first_ns - time.monotonic_ns() - _LEAD_NS) // timing.step_ns) * timing.step_ns
        drive(client, controller, study.task.scenario(), first_ns, timing.period_ns, study.live_duration_s)
    finally:
        client.close()
        listener.close()
    deadline_s = time.monotonic() + _RECORDED_TIMEOUT_S
    while time.monotonic() < deadline_s:
        supervisor.poll()
        found = sorted((lab.recorder.folder / lab.name / rig).glob("*.mcap"))
        if found:
            return open_run(found[-1])
        time.sleep(POLL_S)
    raise OperationError(f"{lab.recorder.folder}: no recording of rig {rig!r} after {_RECORDED_TIMEOUT_S:g} s")
