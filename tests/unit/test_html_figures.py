"""A figure in a page: an image for each column of its panels, with everything that belongs to it and nothing else."""

import re
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from hilrig_replay.report.html_figures import picture
from hilrig_replay.report.report import report
from hilrig_runtime.errors import InputError
from support.recordings import Script, record


def images(html: str) -> list[np.ndarray]:
    found = re.findall(r'flex: (\d+)" src="data:image/png;base64,([^"]+)"', html)
    pixels = [imread(BytesIO(b64decode(data))) for _, data in found]
    assert [image.shape[1] for image in pixels] == [int(width) for width, _ in found]
    return pixels


def dark_columns(image: np.ndarray) -> np.ndarray:
    return np.flatnonzero((image[:, :, :3] < 0.9).any(axis=(0, 2)))


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_a_figure_is_cut_between_its_columns_and_through_no_label(columns: int) -> None:
    figure = Figure(figsize=(11, 4), layout="constrained", dpi=110)
    for axes in np.atleast_2d(figure.subplots(2, columns)).flat:
        # Labels stand out on both sides of a panel: the last tick's to the right, the axis's own to the left.
        axes.set(xlim=(0, 1000), ylabel="samples", xticks=[0, 1000])
        axes.set_yticks([0, 1], ["a long name", "another"])
    pieces = images(picture(figure, "panels"))
    assert len(pieces) == columns
    assert sum(piece.shape[1] for piece in pieces) == 1210
    for piece in pieces:
        dark = dark_columns(piece)
        assert dark[0] > 1
        assert dark[-1] < piece.shape[1] - 2
    # Each has the names left of its panels: before the longest line, its axis, there is more than a label's width.
    for piece in pieces:
        axis = (piece[:, :, :3] < 0.3).all(axis=2).sum(axis=0).argmax()
        assert axis - dark_columns(piece)[0] > 60


def test_many_processes_make_the_same_report_as_one(tmp_path: Path) -> None:
    whole = record(tmp_path / "run.mcap", Script(seconds=1.0, controllers=False))
    paths = [whole]
    for length in (500, 1000, 2000):
        paths.append(tmp_path / f"torn-{length}.mcap")
        paths[-1].write_bytes(whole.read_bytes()[:length])
    shares: list[float] = []
    alone, together = report(paths), report(paths, workers=2, tick=shares.append)
    assert together == alone
    assert len(together.runs) == 1
    assert [path.name in reason for path, reason in zip(paths[1:], together.left_out, strict=True)] == [True] * 3
    assert shares == [0.25, 0.5, 0.75, 1.0]


def test_a_report_of_one_damaged_file_says_so(tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        report([torn], workers=None)
