"""Example controller for `hilrig study`: a PD law in plain Python. Copy and modify it, and name it in a study file.

`update` is called once per poll. Positions and goals are rad, rad, m, rad; it returns four efforts, N·m, N·m, N, N·m.
"""

KP = (23.0, 14.0, 30.0, 0.25)  # N·m/rad, N·m/rad, N/m, N·m/rad
KD = (4.6, 2.9, 2.0, 0.03)  # N·m·s/rad, N·m·s/rad, N·s/m, N·m·s/rad
WEIGHT = (0.0, 0.0, -0.5 * 9.81, 0.0)  # joint 3 is positive downward: compensates the weight of the quill


class Controller:
    """PD controller; each run has its own instance."""

    def __init__(self, period_s: float, gain: float) -> None:
        """Store the poll period, s, and the gain factor of the study."""
        self.period_s = period_s
        self.gain = gain
        self.before: list[float] | None = None
        self.speed = [0.0] * 4

    def update(self, time_s: float, position: list[float], goal: list[float], latency_s: float) -> list[float]:
        """Return the efforts; the gain is reduced at the start, and for large loop latencies."""
        gain = self.gain * min(1.0, 0.2 + time_s) / (1 + latency_s)
        if self.before is not None:
            moved = [(p - b) / self.period_s for p, b in zip(position, self.before, strict=True)]
            self.speed = [0.4 * s + 0.6 * m for s, m in zip(self.speed, moved, strict=True)]
        self.before = position
        terms = zip(KP, KD, position, goal, self.speed, WEIGHT, strict=True)
        return [gain * (kp * (g - p) - kd * s) + w for kp, kd, p, g, s, w in terms]
