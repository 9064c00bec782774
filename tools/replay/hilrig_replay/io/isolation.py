"""Isolation of recordings: an error in the evaluation of one becomes an error that names the file.

A list of recordings shows such an error in one line, and evaluates the other recordings.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

from hilrig_runtime.errors import HilrigError, InputError, OperationError

logger = logging.getLogger(__name__)


class EvaluationError(InputError):
    """A recording whose content can't be evaluated."""

    def __init__(self, path: Path, error: Exception) -> None:
        self.description = (
            f"can't be evaluated: {type(error).__name__}: {error}; its content is unusual or damaged: run "
            "`hilrig recover` on it, and please report the file if the error remains"
        )
        """The defect and its fix, without the file name."""
        super().__init__(f"{path}: {self.description}")


@contextlib.contextmanager
def isolated(path: Path) -> Iterator[None]:
    """Turn any error of the block into a `HilrigError` that names the recording.

    Raises:
        HilrigError: raised by the block.
        EvaluationError: the block raised another error.
        OperationError: the system refused a file operation or memory.
    """
    try:
        yield
    except (HilrigError, BrokenPipeError):
        raise
    except MemoryError as error:
        raise OperationError(f"{path}: out of memory: raise the limit (ulimit -v), or stop other programs") from error
    except OSError as error:
        raise OperationError(f"{path}: can't be evaluated: {error.strerror or error}") from error
    except Exception as error:
        logger.debug("%s", path, exc_info=True)
        raise EvaluationError(path, error) from error
