"""Checks of metadata records, which have no checksum: their numbers, and the copies at the end of a file. Pure."""

from typing import Final

from mcap.records import Metadata

from hilrig_recorder.mcap_format.records import COPY_SUFFIX, DamagedError

MAX_STEP_NS: Final = 10_000_000_000
"""Largest duration of a simulation step; that of a lab is at most 1 s."""
MAX_TEXT: Final = 1000
"""Maximum number of characters of a name; those of hilrig have up to 128. A terminal wraps a long one for minutes."""
_MAX_NUMBER: Final = (1 << 64) - 1
_MAX_COUNT: Final = (1 << 63) - 1
_Ranges = dict[str, tuple[int, int]]
_LOSSES: Final = ("lost_transport", "lost_recorder", "lost_batches")
_RANGES: Final[dict[str, _Ranges]] = {
    "hilrig.session": {"part": (0, 1_000_000), "last_part": (0, 1_000_000), "start_wall_ns": (0, _MAX_COUNT)},
    "hilrig.config": {"step_ns": (1, MAX_STEP_NS), "incarnation": (0, _MAX_NUMBER)},
    "hilrig.summary": dict.fromkeys(
        (*_LOSSES, "overruns", "missed_steps", "clock_steps", "messages", "end_wall_ns"), (0, _MAX_COUNT)
    ),
    "hilrig.recovered": dict.fromkeys(
        ("messages", "chunks", "damaged_chunks", "damaged_bytes", "torn_bytes", "orphans"), (0, _MAX_COUNT)
    ),
}
"""Smallest and largest value of each number, by name of the record and key."""


def check_numbers(record: Metadata, offset: int) -> None:
    """Check the numbers of a metadata record of hilrig.

    Raises:
        DamagedError: a value is not a decimal number, or out of its range, or a text of the session is too long;
            `offset` is the place of the record.
    """
    for key, (low, high) in _RANGES.get(record.name.removesuffix(COPY_SUFFIX), {}).items():
        text = record.metadata.get(key, "0" if low == 0 else str(low))
        # The length is checked first, because the conversion of a long text takes long.
        if not (text.isascii() and text.isdecimal() and len(text) <= len(str(high)) and low <= int(text) <= high):
            raise DamagedError(f"metadata {record.name}: {key} is {text[:40]!r}, expected {low} to {high}", offset)
    if record.name.removesuffix(COPY_SUFFIX) == "hilrig.session":
        for key, text in record.metadata.items():
            if len(text) > MAX_TEXT:
                found = f"{key} has {len(text)} characters, expected at most {MAX_TEXT}"
                raise DamagedError(f"metadata {record.name}: {found}", offset)


def add_metadata(known: dict[str, dict[str, str]], record: Metadata, offset: int) -> bool:
    """Add a record to the metadata of a file, by its name without `COPY_SUFFIX`; False: it repeats a known one.

    Raises:
        DamagedError: a copy differs from the first one, which is kept.
    """
    name = record.name.removesuffix(COPY_SUFFIX)
    if name == record.name or name not in known:
        known[name] = dict(record.metadata)
        return True
    if known[name] != record.metadata:
        raise DamagedError(f"metadata {record.name} differs from its first copy", offset)
    return False
