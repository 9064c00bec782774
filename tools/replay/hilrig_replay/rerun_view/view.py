"""Runs into the rerun viewer: a file, a window, or a browser on this machine."""

from collections.abc import Callable, Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.run import Run
from hilrig_replay.plots.palette import RUN_COLORS
from hilrig_replay.rerun_view.layout import layout
from hilrig_replay.rerun_view.rig_view import Drawn, RigView
from hilrig_replay.rerun_view.sinks import to_file, to_viewer
from hilrig_runtime.errors import InputError, OperationError


def drawn(run: Run) -> Drawn:
    """What a recording says of its rig's looks.

    Raises:
        InputError: it says something that is not understood.
    """
    try:
        return Drawn.of(run.urdf, run.parameters_json, run.step_ns, recorded_task(run))
    except InputError as error:
        raise InputError(f"{run.path}: {error}") from error


def save_rrd(runs: Run | Sequence[Run], path: Path) -> None:
    """Write runs as one rerun recording with its layout; several stand in one scene, side by side in the plots.

    Raises:
        InputError: a run can't be read.
        OperationError: the file can't be written.
    """
    chosen = [runs] if isinstance(runs, Run) else list(runs)
    _write(to_file(path, _name(chosen), _layout(chosen)), chosen, flush_blocks=True)


def send_runs(runs: Sequence[Run], grpc_port: int, over: Callable[[], bool]) -> None:
    """Send runs to a viewer on this machine as `save_rrd` writes them; ends early when it is `over`.

    A viewer that serves a file keeps a core busy for as long as it runs (https://github.com/rerun-io/rerun/pull/10944);
    one that is sent the same waits.

    Raises:
        InputError: a run can't be read.
    """
    _write(to_viewer(grpc_port, _name(runs), _layout(runs)), runs, over)


def root_names(runs: Sequence[Run]) -> list[str]:
    """Entity path of each run: none for a single one, else its session."""
    if len(runs) == 1:
        return [""]
    names = [run.session for run in runs]
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names, start=1)]


def _name(runs: Sequence[Run]) -> str:
    return "+".join(run.session for run in runs)


def _layout(runs: Sequence[Run]) -> rrb.Blueprint:
    return layout(root_names(runs))


def _write(
    stream: rr.RecordingStream,
    runs: Sequence[Run],
    over: Callable[[], bool] = lambda: False,
    *,
    flush_blocks: bool = False,
) -> None:
    """Write runs block by block.

    rerun encodes and writes on threads of its own, and holds the arrays of all blocks that are not written yet. With
    `flush_blocks`, each block is written before the next one is read, so the memory does not depend on the length of
    the run or on the scheduling of those threads. A viewer is not flushed, because it may close at any time.
    """
    with stream:
        for number, (run, root) in enumerate(zip(runs, root_names(runs), strict=True)):
            color = None if len(runs) == 1 else RUN_COLORS[number % len(RUN_COLORS)]
            view = RigView(stream, drawn(run), run.timebase, run.names, root=root, color=color)
            for block in run.blocks():
                if over():
                    return
                view.add(block)
                if flush_blocks:
                    stream.flush()
            view.end()
    stream.disconnect()


def _flush(stream: rr.RecordingStream, file: Path) -> None:
    try:
        stream.flush()
    except RuntimeError as error:
        raise OperationError(f"{file}: can't be written: {error}") from error
