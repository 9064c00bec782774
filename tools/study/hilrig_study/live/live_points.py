"""Live points of a study: each is measured on a rig of a temporary lab and compared with its simulated twins.

The functions that start a lab are arguments, because starting processes belongs to the command line.
"""

import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.config.impairment import (
    BernoulliLoss,
    ConstantDelay,
    LinkImpairment,
    LinkImpairments,
    NoLoss,
    UniformDelay,
)
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.config.template import toml_value
from hilrig_runtime.errors import InputError, OperationError
from hilrig_study.live.live_loop import RigClient, drive, measure_tick_phase
from hilrig_study.live.twin import compare_with_twins
from hilrig_study.study_config import StudyConfig
from hilrig_study.sweep import cell_at

CLOCK_RIG: Final = "clock"
"""Rig without impairment, on which the tick times are measured."""
POLL_S: Final = 0.05
"""Poll period while waiting for a recording, s."""
_LEAD_NS: Final = 200_000_000
_RECORDED_TIMEOUT_S: Final = 20.0

CheckProcesses = Callable[[], object]
"""Raises an error if a service of the lab has ended."""
StartLab = Callable[[LabConfig, Path], AbstractContextManager[CheckProcesses]]
"""Starts the services of a lab read from a file; leaving the context ends them."""
FindPorts = Callable[[int, int], int]
"""Returns the first of `count` adjacent free ports, starting the search at `first`."""


def run_live_points(
    study: StudyConfig,
    folder: Path,
    out: Path,
    start_lab: StartLab,
    find_ports: FindPorts,
    report: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Measure every live point of a study and compare it with its twins; return JSON values, one entry per point.

    Args:
        study: the study.
        folder: folder of the study file.
        out: folder for the lab file and the recordings.
        start_lab: starts the lab of the live points.
        find_ports: finds free TCP ports.
        report: called with progress messages.

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
        rigs = {f"point{i + 1}": _point_impairments(study, cells[i]) for i in indices}
        _write_lab(config, study, step_ms, rigs, recordings, find_ports)
        lab = load_lab(config)
        with start_lab(lab, config) as check_processes:
            for index in indices:
                point, number = points[index]
                report(f"live: {names[number]} at {study.x.label} {point.x:g}, {study.y.label} {point.y:g}")
                run = _run_point(study, folder, lab, f"point{index + 1}", cells[index], check_processes)
                place = {"x": point.x, "y": point.y, "controller": names[number], "recording": str(run.path)}
                compared.append(place | asdict(compare_with_twins(study, cells[index], run, folder)))
    return compared


def _point_impairments(study: StudyConfig, cell: np.ndarray[Any, np.dtype[np.void]]) -> LinkImpairments:
    """Return the link impairments of a point.

    Raises:
        InputError: the command link is impaired by the study and by the swept values.
    """
    base = study.link_impairments(int(cell["controller"][0]))
    delay_ms, jitter_ms, loss = (float(cell[name][0]) for name in ("delay_ms", "jitter_ms", "loss"))
    if not (delay_ms or jitter_ms or loss):
        return base
    if not base.command.is_inactive:
        raise InputError(
            "live points: the command link is impaired by the study and by a swept value; use only one of them"
        )
    delay = (
        UniformDelay(low_ms=delay_ms, high_ms=delay_ms + jitter_ms) if jitter_ms else ConstantDelay(delay_ms=delay_ms)
    )
    command = LinkImpairment(delay=delay, loss=BernoulliLoss(rate=loss) if loss else NoLoss())
    return base.model_copy(update={"command": command})


def _write_lab(
    config: Path,
    study: StudyConfig,
    step_ms: float,
    rigs: Mapping[str, LinkImpairments],
    recordings: Path,
    find_ports: FindPorts,
) -> None:
    single_rig_lab = study.lab(step_ms)
    ports = find_ports(single_rig_lab.edge.first_port, len(rigs) + 1)
    lines = [
        "# Lab of the live points of a study: one rig per point, and one rig without impairment.",
        'name = "study"',
        f"sim = {toml_value(single_rig_lab.sim.model_dump())}",
        f"edge = {toml_value({'first_port': ports, 'session_grace_ms': 0.0})}",
        f"bus = {toml_value({'first_port': find_ports(single_rig_lab.bus.first_port, 3)})}",
        f"recorder = {toml_value({'folder': str(recordings.resolve())})}",
        f"scene = {toml_value({'trays': [], 'parts': []})}",
    ]
    arm = toml_value(single_rig_lab.rigs[0].arm.model_dump())
    for name, links in {CLOCK_RIG: LinkImpairments(), **rigs}.items():
        impairment = {"seed": study.seed, **links.model_dump()}
        lines += ["[[rigs]]", f'name = "{name}"', f"arm = {arm}", f"impairment = {toml_value(impairment)}"]
    try:
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OperationError(f"{config}: can't write the lab file: {error.strerror}") from error


def _run_point(
    study: StudyConfig,
    folder: Path,
    lab: LabConfig,
    rig: str,
    cell: np.ndarray[Any, np.dtype[np.void]],
    check_processes: CheckProcesses,
) -> Run:
    """Run the controller of a point on its rig and return the recording.

    Raises:
        OperationError: no recording was written.
    """
    timing = study.loop.timing(float(cell["step_ms"][0]), float(cell["poll_ms"][0]))
    gain = np.ascontiguousarray(cell["gain"])
    config = study.controllers[cell["controller"][0]]
    parameters = study.rig(float(cell["step_ms"][0]))
    controller = config.build(parameters, study.linear_plant(), timing.period_ns * 1e-9, gain, folder)
    clock_client, client = RigClient(lab.edge.host, lab.ports[CLOCK_RIG]), RigClient(lab.edge.host, lab.ports[rig])
    try:
        tick_ns = measure_tick_phase(clock_client, timing.step_ns)
        # A state arrives at the edge one transport time after its tick; the phase is relative to the tick.
        first_ns = tick_ns + timing.phase_ns - timing.transport_ns
        first_ns += -((first_ns - time.monotonic_ns() - _LEAD_NS) // timing.step_ns) * timing.step_ns
        drive(client, controller, study.task.scenario(), first_ns, timing.period_ns, study.live_duration_s)
    finally:
        client.close()
        clock_client.close()
    deadline_s = time.monotonic() + _RECORDED_TIMEOUT_S
    while time.monotonic() < deadline_s:
        check_processes()
        found = sorted((lab.recorder.folder / lab.name / rig).glob(MCAP_PATTERN))
        if found:
            return open_run(found[-1])
        time.sleep(POLL_S)
    raise OperationError(f"{lab.recorder.folder}: no recording of rig {rig!r} after {_RECORDED_TIMEOUT_S:g} s")
