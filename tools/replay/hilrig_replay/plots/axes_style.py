"""Common style of the panels of all plots."""

from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from hilrig_replay.plots.palette import TEXT_COLOR


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Set title and axis labels of a panel."""
    axes.set_title(title, fontsize=9, loc="left", color=TEXT_COLOR)
    axes.set_xlabel(x, fontsize=8, color=TEXT_COLOR)
    axes.set_ylabel(y, fontsize=8, color=TEXT_COLOR)
    axes.tick_params(labelsize=8, colors=TEXT_COLOR)
    axes.spines[["top", "right"]].set_visible(False)


def set_log_scale(axes: Axes) -> None:
    """Set a logarithmic y axis with plain tick labels.

    Minor ticks and mathtext labels would take as long to draw as the rest of the figure.
    """
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
