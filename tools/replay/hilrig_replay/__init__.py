"""Reads and analyzes recordings. The public names are those of docs/notebook.md: `from hilrig_replay import open_run`.

They are imported on first access, so that a command which needs a single module does not load all of them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from hilrig_replay.analysis.latency import measure
    from hilrig_replay.analysis.stages import STAGES
    from hilrig_replay.analysis.summary import summarize
    from hilrig_replay.io.run import open_run

__all__ = ["STAGES", "measure", "open_run", "summarize"]

_MODULES: Final = {
    "STAGES": "hilrig_replay.analysis.stages",
    "measure": "hilrig_replay.analysis.latency",
    "open_run": "hilrig_replay.io.run",
    "summarize": "hilrig_replay.analysis.summary",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
