"""A student's controller for `hilrig study`: a PD law, in plain Python. Copy it, change it, name it in a study's file.

`update` is called once a poll. Positions and goals are rad, rad, m, rad; it gives four efforts, N·m, N·m, N, N·m.
"""

KP = (23.0, 14.0, 30.0, 0.25)  # N·m/rad, N·m/rad, N/m, N·m/rad
KD = (4.6, 2.9, 2.0, 0.03)  # the same, times seconds
WEIGHT = (0.0, 0.0, -0.5 * 9.81, 0.0)  # joint 3 counts positive downwards: the quill is carried


class Controller:
    """One object a run: what it remembers is its own."""

    def __init__(self, period_s: float, gain: float) -> None:
        """Poll every `period_s`; `gain` is the study's gain factor."""
        self.period_s = period_s
        self.gain = gain
        self.before: list[float] | None = None
        self.speed = [0.0] * 4

    def update(self, time_s: float, position: list[float], goal: list[float], latency_s: float) -> list[float]:
        """Efforts out of positions: softer at the very start, and the slower the loop is."""
        gain = self.gain * min(1.0, 0.2 + time_s) / (1 + latency_s)
        if self.before is not None:
            moved = [(p - b) / self.period_s for p, b in zip(position, self.before, strict=True)]
            self.speed = [0.4 * s + 0.6 * m for s, m in zip(self.speed, moved, strict=True)]
        self.before = position
        terms = zip(KP, KD, position, goal, self.speed, WEIGHT, strict=True)
        return [gain * (kp * (g - p) - kd * s) + w for kp, kd, p, g, s, w in terms]
