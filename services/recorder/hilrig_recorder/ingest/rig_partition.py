"""Which rigs are one recorder's, where several share a lab. Pure."""

from collections.abc import Sequence


class Share:
    """The share of a recorder that was given the rigs `mine` of the rigs `listed` in the lab's file.

    Rigs that are not in the file, because they were added while the lab runs, are the one's that has the first rig of
    the file: so each rig is somebody's, and nobody needs to be asked.
    """

    def __init__(self, listed: Sequence[str], mine: Sequence[str]) -> None:
        self._listed = frozenset(listed)
        self._mine = frozenset(mine)
        self._has_added = listed[0] in self._mine

    def has(self, rig: str) -> bool:
        """Whether a rig is this recorder's."""
        return rig in self._mine or (self._has_added and rig not in self._listed)

    def lists(self, rig: str) -> bool:
        """Whether it is, and stands in the lab's file."""
        return rig in self._mine
