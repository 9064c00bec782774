"""Rerun recordings as places to write to: a file, or a viewer."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from hilrig_replay.io.recording_file import refuse_recording
from hilrig_replay.rerun_view.csp_proxy import LOOPBACK
from hilrig_runtime.errors import InputError, OperationError

APPLICATION = "hilrig"


def to_file(path: Path, name: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """A recording that is written to a file.

    Raises:
        InputError: its folder is not there, or the path names a recording.
        OperationError: the file can't be written.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    refuse_recording(path)
    try:
        # Asked of the system first: its answer is one clear word.
        path.open("wb").close()
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    stream.save(path, default_blueprint=blueprint)
    stream.send_recording_name(name)
    return stream


def to_viewer(grpc_port: int, name: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """A recording that is sent to a viewer on this machine."""
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    stream.connect_grpc(f"rerun+http://{LOOPBACK}:{grpc_port}/proxy", default_blueprint=blueprint)
    stream.send_recording_name(name)
    return stream
