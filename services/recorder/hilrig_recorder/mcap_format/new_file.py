"""A new MCAP file that exists completely or not at all: written beside its target, then renamed."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hilrig_recorder.mcap_format.file_names import recovering_path
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_runtime.errors import InputError, OperationError


@contextlib.contextmanager
def new_file(path: Path, **options: Any) -> Iterator[RecordingWriter]:
    """Yield the writer of a file; it gets the name `path` if the block succeeds, which must call `finish`.

    Args:
        path: the new file.
        options: arguments of `RecordingWriter`.

    Raises:
        InputError: `path` exists.
        OperationError: the file can't be written, or not completely.
    """
    temporary_path = recovering_path(path)
    try:
        if path.exists():
            raise InputError(f"{path}: file exists and is not overwritten: choose another output name")
        # Left behind by a process that was killed.
        temporary_path.unlink(missing_ok=True)
        writer = RecordingWriter(path, temporary_path=temporary_path, **options)
        try:
            yield writer
            if writer.dropped_count:
                raise OperationError(f"{path}: can't be written: no space left on the disk")
            writer.publish()
        except BaseException:
            writer.discard()
            raise
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error
