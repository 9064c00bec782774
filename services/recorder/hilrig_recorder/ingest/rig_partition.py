"""Partition of the rigs of a lab among its recorders. Pure."""

from collections.abc import Sequence


class RigPartition:
    """The rigs that one recorder records.

    Rigs that are added while the lab runs belong to the recorder of the first configured rig. So each rig has exactly
    one recorder, without communication between the recorders.

    Args:
        configured: all rigs in the lab file.
        assigned: the rigs assigned to this recorder.
    """

    def __init__(self, configured: Sequence[str], assigned: Sequence[str]) -> None:
        self._configured = frozenset(configured)
        self._assigned = frozenset(assigned)
        self._has_added = configured[0] in self._assigned

    def contains(self, rig: str) -> bool:
        """Whether this recorder records the rig."""
        return rig in self._assigned or (self._has_added and rig not in self._configured)

    def contains_configured(self, rig: str) -> bool:
        """Whether this recorder records the rig, and the rig is in the lab file."""
        return rig in self._assigned
