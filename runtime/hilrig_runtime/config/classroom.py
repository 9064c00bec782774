"""The `[classroom]` section of `lab.toml`: who owns which rig; see docs/classroom.md."""

from collections.abc import Collection
from pathlib import Path

from hilrig_runtime.config.roster import Roster, check_rigs, read_roster
from hilrig_runtime.config.types import Section


class ClassroomConfig(Section):
    """Owners of the rigs: the students of a roster."""

    roster: Path
    """Roster of the class, a CSV file with the columns id, name, group, rig."""
    claims: Path | None = None
    """Folder of the codes with which students claim rigs (`hilrig rig codes`), and of their claims: a rig that is not
    claimed can't be written. Default: no codes; a rig is that of its students in the roster."""

    def students(self, rigs: Collection[str]) -> Roster:
        """Return the roster; `rigs` are those of the lab.

        Raises:
            InputError: the file can't be read or has mistakes; names each with its line.
        """
        roster = read_roster(self.roster)
        check_rigs(self.roster, roster, rigs, claimed=self.claims is not None)
        return roster
