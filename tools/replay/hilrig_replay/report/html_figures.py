"""Figures as images in a page: their columns stand beside each other, on a narrow page one below the other."""

from base64 import b64encode
from html import escape
from io import BytesIO
from itertools import pairwise
from typing import Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

_GAP: Final = 7
"""Columns of panels are at least so far apart, px; constrained layout sees to it."""


def picture(figure: Figure, what: str) -> str:
    """A figure as HTML, an image for each column of its panels.

    Args:
        figure: one with constrained layout; it loses its title, for the page has its own.
        what: said to those who can't see it.
    """
    figure.suptitle("")
    canvas = FigureCanvasAgg(figure)
    # This lays out too; `savefig` would go through all panels once more for that.
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    edges = [0, *_between_columns(figure, pixels), pixels.shape[1]]
    images = "".join(_image(pixels[:, left:right], what) for left, right in pairwise(edges))
    return f'<div class="picture">{images}</div>'


def _between_columns(figure: Figure, pixels: NDArray[np.uint8]) -> list[int]:
    """Where one column of panels ends and the next one's labels have not begun, from the left, px."""
    blank = (pixels == pixels[0, 0]).all(axis=(0, 2))
    spans = sorted({(box.x0, box.x1) for axes in figure.axes for box in (axes.get_position(),)})
    found, end = [], spans[0][1]
    for begin, until in spans:
        if begin > end:
            first = int(end * figure.bbox.width)
            gap = np.lib.stride_tricks.sliding_window_view(blank[first:], _GAP).all(axis=1)
            found.append(first + int(gap.argmax()) + _GAP // 2)
        end = max(end, until)
    return found


def _image(pixels: NDArray[np.uint8], what: str) -> str:
    with BytesIO() as file:
        imsave(file, np.ascontiguousarray(pixels), format="png")
        data = b64encode(file.getvalue()).decode()
    width = pixels.shape[1]
    return f'<img alt="{escape(what, quote=True)}" style="flex: {width}" src="data:image/png;base64,{data}">'
