"""Output files: written beside the target and renamed, so that an input or a recording is never replaced or truncated.

Every command that writes a result uses `output_file`; `check_output` reports an unusable name before the computation.
"""

import contextlib
import os
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MAGIC, MCAP_SUFFIX, PART_SUFFIX
from hilrig_runtime.errors import InputError, OperationError


def check_output(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Check the name of an output file.

    Args:
        path: the output file.
        inputs: the files that the command reads.

    Raises:
        InputError: the folder does not exist, or the name is that of a folder, an input or a recording.
    """
    try:
        if not path.parent.is_dir():
            raise InputError(f"{path}: folder {path.parent} does not exist")
        if path.is_dir():
            raise InputError(f"{path}: is a folder; expected the name of a file")
        if not path.is_file():
            # A new file, or a device such as /dev/stdout.
            return
        if any(given.exists() and path.samefile(given) for given in inputs):
            raise InputError(f"{path} is an input of this command and is not overwritten: choose another output name")
    except OSError as error:
        raise InputError(f"{path}: can't be used as an output: {error.strerror or error}") from error
    if path.name.removesuffix(PART_SUFFIX).endswith(MCAP_SUFFIX) or _has_magic(path):
        raise InputError(f"{path} is a recording and is not overwritten: choose another output name")


@contextlib.contextmanager
def output_file(path: Path, inputs: Iterable[Path] = (), *, mode: int = 0o666) -> Iterator[Path]:
    """Yield the path of a new file in the same folder, which gets the name `path` when the block succeeds.

    Args:
        path: the output file. A device is written directly.
        inputs: the files that the command reads.
        mode: access rights of the file, without those of the process's umask.

    Raises:
        InputError: as `check_output`.
        OperationError: the file can't be written.
    """
    inputs = tuple(inputs)
    check_output(path, inputs)
    try:
        if path.exists() and not path.is_file():
            yield path
            return
        # The file behind a symbolic link is replaced, not the link.
        target = path.resolve()
        # A short name: that of the target may have the maximum length. The suffix selects the format of a plot.
        temporary = target.with_name(f".hilrig-{secrets.token_hex(4)}{target.suffix[:8]}")
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
        try:
            yield temporary
            check_output(path, inputs)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error


def _has_magic(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        # Writing the file reports the error.
        return False
