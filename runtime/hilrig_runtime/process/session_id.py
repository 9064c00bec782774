"""The ids of sessions: `<UTC time>-<rig>-<4 letters>`, with the id of a student before the letters."""

import random
import string
from datetime import UTC, datetime

from hilrig_schemas.bounds import MAX_SESSION_ID
from hilrig_schemas.topics import is_name


def session_id(rig: str, wall_ns: int, rng: random.Random, student: str = "") -> str:
    """Return the id of a session that starts at `wall_ns` (wall clock, ns); the letters distinguish equal seconds.

    `student`: id of the owner of the rig; left out if the rig has none or several, or if the id would be too long.
    """
    time = datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
    letters = "".join(rng.choices(string.ascii_lowercase, k=4))
    with_student = f"{time}-{rig}-{student}-{letters}"
    return with_student if is_name(student) and len(with_student) <= MAX_SESSION_ID else f"{time}-{rig}-{letters}"
