"""The terminal of a command: text from outside is shown, never executed."""

import os
import sys
from collections.abc import Iterable
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.segment import Segment
from rich.table import Table

from hilrig_runtime.escaping import printable


class TerminalConsole(Console):
    """A console that escapes control characters in everything it prints, and does not interpret markup by default."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"markup": False, **options})

    def _render_buffer(self, buffer: Iterable[Segment]) -> str:
        return super()._render_buffer(
            segment if segment.control else Segment(printable(segment.text, keep="\n"), segment.style)
            for segment in buffer
        )


class TerminalTable(Table):
    """A table as all commands print it: without lines between the columns it fits a terminal of 80 characters."""

    def __init__(self, *headers: str, title: str | None = None, **options: Any) -> None:
        look = {"title_justify": "left", "title_style": "bold", "box": SIMPLE_HEAD, "padding": (0, 1, 0, 0)}
        super().__init__(*headers, title=title, **{**look, **options})


def has_fixed_width() -> bool:
    """Whether a terminal, or the variable COLUMNS, determines the width of standard output."""
    return sys.stdout.isatty() or "COLUMNS" in os.environ
