"""Colors and names of joints, runs and events, common to the viewer, plots and reports."""

from collections.abc import Sequence
from typing import Final

TEXT_COLOR: Final = "#333333"
LOOP_COLOR: Final = "#4c78a8"
AGE_COLOR: Final = "#e45756"
"""Age of the loop at each step."""
JOINT_SYMBOLS: Final = ("θ1", "θ2", "d3", "θ4")
JOINT_COLORS: Final = ("#4c78a8", "#f58518", "#54a24b", "#b279a2")
COLOR_NAMES: Final = {
    "#4c78a8": "blue",
    "#f58518": "orange",
    "#54a24b": "green",
    "#b279a2": "purple",
    "#72b7b2": "teal",
    "#e45756": "red",
    "#eeca3b": "yellow",
    "#ff9da6": "pink",
}
"""Names of the colors of joints and stages, for legends in words."""
PALE_JOINT_COLORS: Final = ("#9db7d5", "#f9c58b", "#a4cf9d", "#d3b3ca")
EFFORT_SYMBOLS: Final = ("τ1", "τ2", "τ3", "τ4")
RUN_COLORS: Final = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#72b7b2", "#eeca3b")
"""Colors of compared runs, and of controllers."""
SEVERITY_COLORS: Final = {"INFO": "#9aa5b1", "WARNING": "#f2b134", "ERROR": "#e45756"}
EVENT_COLORS: Final = {"PART_PICKED": "#6fd08c", "PART_DROPPED": "#eeca3b", "LIMIT_HIT": "#b279a2"}
"""Colors of event kinds; all other kinds have the color of their severity."""


def event_title(kind: str) -> str:
    """Name of an event kind in reports and in the viewer."""
    return kind.replace("_", " ").lower()


def legend_in_words(names: Sequence[str], colors: Sequence[str]) -> str:
    """Legend of curves as text: "θ1 blue, θ2 orange"; a box would cover a part of the curves."""
    return ", ".join(f"{name} {COLOR_NAMES[color]}" for name, color in zip(names, colors, strict=True))


def severity_color(severity: str) -> str:
    """Color of a severity; a severity of a later version has that of INFO."""
    return SEVERITY_COLORS.get(severity, SEVERITY_COLORS["INFO"])


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue of a color `#rrggbb`, each 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
