"""Writes runs as rerun recordings: into a file, or to a viewer on this host."""

from collections.abc import Callable, Sequence
from pathlib import Path

import rerun as rr

from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.output_file import output_file
from hilrig_replay.io.run import Run
from hilrig_replay.plots.palette import RUN_COLORS
from hilrig_replay.rerun_view import entity_paths as paths
from hilrig_replay.rerun_view.layout import layout
from hilrig_replay.rerun_view.rig_view import RerunRigWriter, RigGeometry
from hilrig_replay.rerun_view.sinks import flush_file, to_file, to_viewer
from hilrig_replay.rerun_view.value_axes import ValueRanges
from hilrig_runtime.errors import InputError


def geometry_of(run: Run) -> RigGeometry:
    """Geometry of a recorded rig.

    Raises:
        InputError: the recording's URDF or parameters are invalid.
    """
    try:
        return RigGeometry.of(run.urdf, run.parameters_json, run.step_ns, recorded_task(run))
    except InputError as error:
        raise InputError(f"{run.path}: {error}") from error


def save_rrd(runs: Run | Sequence[Run], path: Path) -> None:
    """Write runs as one rerun recording with its layout; several runs share one scene and the plots.

    Raises:
        InputError: a run can't be read, or the file is one of the runs or another recording.
        OperationError: the file can't be written.
    """
    chosen = [runs] if isinstance(runs, Run) else list(runs)
    with output_file(path, [path for run in chosen for path in run.file.paths]) as temporary:
        _write(to_file(temporary, _name(chosen), layout(root_names(chosen))), chosen, file=path)


def send_runs(runs: Sequence[Run], grpc_port: int, is_closed: Callable[[], bool]) -> None:
    """Send runs to a viewer on this host, with the content that `save_rrd` writes; stops early when `is_closed()`.

    A viewer that serves a file keeps a core busy for as long as it runs (https://github.com/rerun-io/rerun/pull/10944);
    a viewer that receives the same data over gRPC is idle afterwards.

    Raises:
        InputError: a run can't be read.
    """
    _write(to_viewer(grpc_port, _name(runs), layout(root_names(runs))), runs, is_closed)


def root_names(runs: Sequence[Run]) -> list[str]:
    """Root entity path of each run: empty for a single run, otherwise its session."""
    if len(runs) == 1:
        return [""]
    names = [run.session for run in runs]
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names, start=1)]


def _name(runs: Sequence[Run]) -> str:
    return "+".join(run.session for run in runs)


def _write(
    stream: rr.RecordingStream,
    runs: Sequence[Run],
    is_closed: Callable[[], bool] = lambda: False,
    *,
    file: Path | None = None,
) -> None:
    """Write runs block by block to a viewer, or to a file.

    rerun encodes and writes on its own threads and holds every block that is not written yet. A file is flushed after
    each block, so the memory depends neither on the length of the run nor on the scheduling of these threads. A viewer
    is not flushed, because it may close at any time. The ranges of the plots and the role are known at the end.
    """
    ranges, client_role = ValueRanges(), False
    with stream:
        for number, (run, root) in enumerate(zip(runs, root_names(runs), strict=True)):
            color = None if len(runs) == 1 else RUN_COLORS[number % len(RUN_COLORS)]
            view = RerunRigWriter(stream, geometry_of(run), run.timebase, run.names, root=root, color=color)
            for block in run.blocks():
                if is_closed():
                    return
                view.add(block)
                ranges.add(block)
                if file is not None:
                    flush_file(stream, file)
            view.end()
            ranges.extend(paths.LOOP_AGE, [view.largest_age_ms])
            client_role = view.client_role
        stream.send_blueprint(layout(root_names(runs), client_role=client_role, ranges=ranges.ranges()))
    stream.disconnect()
