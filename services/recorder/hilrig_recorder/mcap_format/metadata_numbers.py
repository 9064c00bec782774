"""Checks the numbers in the metadata records of a recording: they have no checksum, so damage can change them. Pure."""

from typing import Final

from mcap.records import Metadata

from hilrig_recorder.mcap_format.records import DamagedError

MAX_STEP_NS: Final = 10_000_000_000
"""Largest duration of a simulation step; that of a lab is at most 1 s."""
_MAX_NUMBER: Final = (1 << 64) - 1
_MAX_COUNT: Final = (1 << 63) - 1
_Ranges = dict[str, tuple[int, int]]
_LOSSES: Final = ("lost_transport", "lost_recorder", "lost_batches")
_RANGES: Final[dict[str, _Ranges]] = {
    "hilrig.session": {"part": (0, 1_000_000), "start_wall_ns": (0, _MAX_COUNT)},
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
        DamagedError: a value is not a decimal number, or out of its range; `offset` is the place of the record.
    """
    for key, (low, high) in _RANGES.get(record.name, {}).items():
        text = record.metadata.get(key, "0" if low == 0 else str(low))
        # The length is checked first, because the conversion of a long text takes long.
        if not (text.isascii() and text.isdecimal() and len(text) <= len(str(high)) and low <= int(text) <= high):
            raise DamagedError(f"metadata {record.name}: {key} is {text[:40]!r}, expected {low} to {high}", offset)
