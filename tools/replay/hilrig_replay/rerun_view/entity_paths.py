"""Entity paths in the viewer, relative to the root of a rig: `RerunRigWriter` writes them, `layout` shows them."""

from typing import Final

SCENE: Final = "scene"
ARM_ROOT: Final = f"{SCENE}/arm_root"
JOINTS: Final = f"{SCENE}/joints"
"""One child a joint."""
PARTS: Final = f"{SCENE}/parts"
"""One child a part."""
TASK: Final = f"{SCENE}/task"
"""One child a target pose, and `TASK_PATH`."""
TASK_PATH: Final = f"{TASK}/path"
TRAIL: Final = f"{SCENE}/trail"
WORKSPACE: Final = f"{SCENE}/workspace"
POSITION: Final = "position"
VELOCITY: Final = "velocity"
EFFORT: Final = "effort"
COMMANDED_EFFORT: Final = f"{EFFORT}/commanded"
APPLIED_EFFORT: Final = f"{EFFORT}/applied"
LATENCY_STAGES: Final = "stages"
LOOP_LATENCY: Final = "loop"
LOOP_AGE: Final = "age"
TICK_LATENESS: Final = "lateness"
STATES: Final = "states"
"""One child a state timeline."""
MODBUS: Final = "modbus"
"""One child a client, with one child a kind of request."""
EVENTS: Final = "events"
EVENT_MARKERS: Final = "markers"
"""One child an event kind."""


def entity_path(root: str, path: str) -> str:
    """Absolute entity path of a rig's `path`; `root` is empty if it is the only rig."""
    return f"/{root}/{path}" if root else f"/{path}"


def arm_path(root: str) -> str:
    """Entity path of a rig's URDF; rerun's URDF loader accepts a path of one element only."""
    return f"{root}_arm" if root else "arm"
