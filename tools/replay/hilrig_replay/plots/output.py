"""Writing of figures to files."""

from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from hilrig_replay.io.recording_file import refuse_recording
from hilrig_runtime.errors import InputError, OperationError

FORMATS: Final = (".png", ".svg", ".pdf")


def check_plot_path(path: Path) -> None:
    """Check the output path of a plot, before the plot is computed.

    Raises:
        InputError: its suffix is not a supported format, its folder does not exist, or it is a recording.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"{path}: unsupported plot format {path.suffix!r}; the file name must end in {', '.join(FORMATS)}"
        )
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist")
    refuse_recording(path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file; the suffix selects the format.

    Raises:
        OperationError: the file can't be written.
    """
    try:
        figure.savefig(path)
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error
