"""How a session is called, whoever begins it: `<UTC time>-<rig>-<4 letters>`."""

import random
import string
from datetime import UTC, datetime


def session_id(rig: str, wall_ns: int, letters: random.Random) -> str:
    """Id of a session that begins at `wall_ns` (wall clock, ns); the letters tell apart what begins within a second."""
    time = datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{time}-{rig}-{''.join(letters.choices(string.ascii_lowercase, k=4))}"
