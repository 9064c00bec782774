"""Simulation: a virtual SCARA arm per rig, stepped in real time. The public names are those of docs/notebook.md.

They are imported on first access, so that a command which needs a single module does not load all of them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from hilrig_sim.arm.kinematics import UnreachableError, forward, inverse
    from hilrig_sim.arm.model import ArmParameters

__all__ = ["ArmParameters", "UnreachableError", "forward", "inverse"]

_MODULES: Final = {
    "ArmParameters": "hilrig_sim.arm.model",
    "UnreachableError": "hilrig_sim.arm.kinematics",
    "forward": "hilrig_sim.arm.kinematics",
    "inverse": "hilrig_sim.arm.kinematics",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
