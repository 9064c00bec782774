"""The terminal of a command: text from outside is shown, never executed."""

import os
import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.segment import Segment

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


def has_fixed_width() -> bool:
    """Whether a terminal, or the variable COLUMNS, determines the width of standard output."""
    return sys.stdout.isatty() or "COLUMNS" in os.environ
