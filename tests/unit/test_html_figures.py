"""Figures in HTML pages: one image per column of panels, cut between the labels; reports with worker processes."""

import re
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from hilrig_replay.report.html_figures import html_figure
from hilrig_replay.report.report import build_report
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
def test_figure_is_cut_between_columns_not_through_labels(columns: int) -> None:
    figure = Figure(figsize=(11, 4), layout="constrained", dpi=110)
    for axes in np.atleast_2d(figure.subplots(2, columns)).flat:
        # Labels extend beyond both sides of a panel: the last tick label to the right, the axis label to the left.
        axes.set(xlim=(0, 1000), ylabel="samples", xticks=[0, 1000])
        axes.set_yticks([0, 1], ["a long name", "another"])
    pieces = images(html_figure(figure, "panels"))
    assert len(pieces) == columns
    assert sum(piece.shape[1] for piece in pieces) == 1210
    for piece in pieces:
        dark = dark_columns(piece)
        assert dark[0] > 1
        assert dark[-1] < piece.shape[1] - 2
    # Each piece includes the tick labels at the left: the axis, the longest line, is preceded by a label's width.
    for piece in pieces:
        axis = (piece[:, :, :3] < 0.3).all(axis=2).sum(axis=0).argmax()
        assert axis - dark_columns(piece)[0] > 60


@pytest.mark.long("takes 5 s")
def test_worker_processes_give_the_same_report(tmp_path: Path) -> None:
    complete = record(tmp_path / "run.mcap", Script(seconds=1.0, controllers=False))
    paths = [complete]
    for length in (500, 1000, 2000):
        paths.append(tmp_path / f"truncated-{length}.mcap")
        paths[-1].write_bytes(complete.read_bytes()[:length])
    shares: list[float] = []
    alone, together = build_report(paths), build_report(paths, workers=2, on_progress=shares.append)
    assert together == alone
    assert len(together.runs) == 1
    assert [path.name in reason for path, reason in zip(paths[1:], together.left_out, strict=True)] == [True] * 3
    assert shares == [0.25, 0.5, 0.75, 1.0]


def test_group_figure_has_its_columns_with_long_file_names(tmp_path: Path) -> None:
    folders = [tmp_path / ("long" * 40) / name for name in ("one", "two")]
    for folder in folders:
        folder.mkdir(parents=True)
    page = build_report([record(folder / "run.mcap", Script(seconds=1.0)) for folder in folders]).html
    overview = page[: page.index("<details>")]
    assert len(images(overview)) == 4


def test_report_of_one_damaged_file_raises(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        build_report([empty], workers=None)
