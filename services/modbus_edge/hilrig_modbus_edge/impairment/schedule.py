"""Selects the impairment that is active: lab.toml, its schedule, or an operator's override. Time is passed in."""

from typing import Literal

from hilrig_runtime.config.impairment import ImpairmentConfig, ImpairmentSetting, LinkImpairments

Source = Literal["lab.toml", "schedule", "override"]
"""Origin of the active impairment; "override": set by an operator (`hilrig impair`)."""


class ImpairmentSchedule:
    """The active impairment of one rig over time; the schedule restarts with each session."""

    def __init__(self, lab: ImpairmentConfig) -> None:
        self.source: Source = "lab.toml"
        """Origin of the active impairment."""
        self._lab = self._config = lab
        self._setting: ImpairmentSetting = lab
        self._start_ns: int | None = None
        self._next = 0

    @property
    def links(self) -> LinkImpairments:
        """Active impairment of both links."""
        return self._setting.links

    @property
    def seed(self) -> int:
        """Seed of the active impairment."""
        return self._config.seed

    def set_override(self, config: ImpairmentConfig) -> None:
        """Activate an operator's setting, also for later sessions; it replaces the schedule of lab.toml."""
        self._activate(config, "override")

    def clear_override(self) -> None:
        """Activate the setting of lab.toml again; its schedule restarts with the next session."""
        self._activate(self._lab, "lab.toml")

    def start_session(self, now_ns: int) -> None:
        """Restart the schedule: a session started at `now_ns`, monotonic clock."""
        self._activate(self._config, "override" if self.source == "override" else "lab.toml")
        self._start_ns = now_ns

    def check(self, now_ns: int) -> bool:
        """Apply the schedule entries that are due; return whether the active impairment changed."""
        schedule = self._config.schedule
        before = self._next
        if self._start_ns is None:
            return False
        while self._next < len(schedule) and now_ns >= self._start_ns + round(schedule[self._next].at_s * 1e9):
            self._setting = schedule[self._next]
            self.source = "schedule"
            self._next += 1
        return self._next != before

    def _activate(self, config: ImpairmentConfig, source: Source) -> None:
        self._config = self._setting = config
        self.source = source
        self._start_ns = None
        self._next = 0
