"""Which impairment is in force: as lab.toml and its schedule say, or as set by hand. Pure: time is passed in."""

from typing import Literal

from hilrig_runtime.config.impairment import ImpairmentConfig, ImpairmentSetting, LinkImpairments

Source = Literal["lab.toml", "schedule", "hand"]


class Course:
    """The impairment of one rig as time goes on; a schedule runs from the start of each session."""

    def __init__(self, lab: ImpairmentConfig) -> None:
        self.source: Source = "lab.toml"
        """Who said what is in force."""
        self._lab = self._config = lab
        self._setting: ImpairmentSetting = lab
        self._start_ns: int | None = None
        self._next = 0

    @property
    def links(self) -> LinkImpairments:
        """What is in force."""
        return self._setting.links

    @property
    def seed(self) -> int:
        """Its seed."""
        return self._config.seed

    def set_by_hand(self, config: ImpairmentConfig) -> None:
        """From now on this holds, in the sessions to come too; the lab's schedule rests."""
        self._begin(config, "hand")

    def set_as_lab(self) -> None:
        """What lab.toml says holds again; its schedule goes on with the next session."""
        self._begin(self._lab, "lab.toml")

    def begin_session(self, now_ns: int) -> None:
        """A session began, at `now_ns` of the monotonic clock: the schedule starts anew."""
        self._begin(self._config, "hand" if self.source == "hand" else "lab.toml")
        self._start_ns = now_ns

    def check(self, now_ns: int) -> bool:
        """Follow the schedule; whether something else is in force now."""
        schedule = self._config.schedule
        before = self._next
        if self._start_ns is None:
            return False
        while self._next < len(schedule) and now_ns >= self._start_ns + round(schedule[self._next].at_s * 1e9):
            self._setting = schedule[self._next]
            self.source = "schedule"
            self._next += 1
        return self._next != before

    def _begin(self, config: ImpairmentConfig, source: Source) -> None:
        self._config = self._setting = config
        self.source = source
        self._start_ns = None
        self._next = 0
