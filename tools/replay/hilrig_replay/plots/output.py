"""Writing of figures to files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from hilrig_replay.io.output_file import check_output, output_file
from hilrig_runtime.errors import InputError

FORMATS: Final = (".png", ".svg", ".pdf")


def check_plot_path(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Check the output path of a plot, before the plot is computed.

    Raises:
        InputError: unsupported format, missing folder, or it is a recording or one of the inputs.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"{path}: unsupported plot format {path.suffix!r}; the file name must end in {', '.join(FORMATS)}"
        )
    check_output(path, inputs)


def save_figure(figure: Figure, path: Path, inputs: Iterable[Path] = ()) -> None:
    """Write a figure to a file; the suffix selects the format.

    Raises:
        InputError: the file is a recording or one of the inputs.
        OperationError: the file can't be written.
    """
    with output_file(path, inputs) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower())
