"""The ids of sessions: `<UTC time>-<rig>-<4 letters>`."""

import random
import string
from datetime import UTC, datetime


def session_id(rig: str, wall_ns: int, rng: random.Random) -> str:
    """Return the id of a session that starts at `wall_ns` (wall clock, ns); the letters distinguish equal seconds."""
    time = datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{time}-{rig}-{''.join(rng.choices(string.ascii_lowercase, k=4))}"
