"""Rerun sinks: recording streams into a file or a viewer."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from hilrig_replay.rerun_view.csp_proxy import LOOPBACK
from hilrig_runtime.errors import OperationError

APPLICATION = "hilrig"


def to_file(path: Path, name: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Open a recording stream into a file; the caller has checked its name (`io.output_file`).

    Raises:
        OperationError: the file can't be written.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    with _reports_write_errors(path):
        stream.save(path, default_blueprint=blueprint)
    stream.send_recording_name(name)
    return stream


def flush_file(stream: rr.RecordingStream, path: Path) -> None:
    """Write everything that was sent to a stream of `to_file`, and wait for it.

    Raises:
        OperationError: the file can't be written.
    """
    with _reports_write_errors(path):
        stream.flush()


@contextmanager
def _reports_write_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise OperationError(f"{path}: can't be written: {error}") from error


def to_viewer(grpc_port: int, name: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Open a recording stream to a viewer on this host."""
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    stream.connect_grpc(f"rerun+http://{LOOPBACK}:{grpc_port}/proxy", default_blueprint=blueprint)
    stream.send_recording_name(name)
    return stream
