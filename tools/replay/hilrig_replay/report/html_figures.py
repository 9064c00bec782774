"""Converts figures to HTML images, one per column of panels; a narrow page shows the columns one below the other."""

from base64 import b64encode
from io import BytesIO
from itertools import pairwise
from typing import Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from hilrig_runtime.escaping import as_html

_MIN_COLUMN_GAP_PX: Final = 7
"""Smallest distance between columns of panels; guaranteed by constrained layout."""


def html_figure(figure: Figure, alt: str) -> str:
    """Convert a figure to HTML: an image for each column of its panels.

    Args:
        figure: a figure with constrained layout; its title is removed, because the page has its own headings.
        alt: alternative text of the images.
    """
    figure.suptitle("")
    canvas = FigureCanvasAgg(figure)
    # Also computes the layout; `savefig` would need a second pass over all panels.
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    edges = [0, *_column_boundaries(figure, pixels), pixels.shape[1]]
    images = "".join(_image(pixels[:, left:right], alt) for left, right in pairwise(edges))
    return f'<div class="figure">{images}</div>'


def _column_boundaries(figure: Figure, pixels: NDArray[np.uint8]) -> list[int]:
    """Horizontal positions between columns of panels that cut through no label, from the left, px."""
    blank = (pixels == pixels[0, 0]).all(axis=(0, 2))
    spans = sorted({(box.x0, box.x1) for axes in figure.axes for box in (axes.get_position(),)})
    found, end = [], spans[0][1]
    for begin, until in spans:
        if begin > end:
            first = int(end * figure.bbox.width)
            gap = np.lib.stride_tricks.sliding_window_view(blank[first:], _MIN_COLUMN_GAP_PX).all(axis=1)
            found.append(first + int(gap.argmax()) + _MIN_COLUMN_GAP_PX // 2)
        end = max(end, until)
    return found


def _image(pixels: NDArray[np.uint8], alt: str) -> str:
    with BytesIO() as file:
        imsave(file, np.ascontiguousarray(pixels), format="png")
        data = b64encode(file.getvalue()).decode()
    width = pixels.shape[1]
    return f'<img alt="{as_html(alt)}" style="flex: {width}" src="data:image/png;base64,{data}">'
