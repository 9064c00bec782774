"""PD controller for `hilrig study`, in plain Python: a template to copy, change and use in a study file.

`update` is called once per poll. Positions and goals are in rad, rad, m, rad; it returns four torques in N·m, N·m, N
and N·m.
"""

KP = (23.0, 14.0, 30.0, 0.25)  # N·m/rad, N·m/rad, N/m, N·m/rad
KD = (4.6, 2.9, 2.0, 0.03)  # the same, times seconds
WEIGHT = (0.0, 0.0, -0.5 * 9.81, 0.0)  # compensates the weight of the quill; joint 3 counts positive downwards


class Controller:
    """Controller of one run; each run has its own object, which may hold state."""

    def __init__(self, period_s: float, gain: float) -> None:
        """Create a controller that is polled every `period_s`; `gain` is the study's gain factor."""
        self.period_s = period_s
        self.gain = gain
        self.before: list[float] | None = None
        self.speed = [0.0] * 4

    def update(self, time_s: float, position: list[float], goal: list[float], latency_s: float) -> list[float]:
        """Compute torques from positions; the gain is reduced in the first 0.8 s and with the loop latency."""
        gain = self.gain * min(1.0, 0.2 + time_s) / (1 + latency_s)
        if self.before is not None:
            moved = [(p - b) / self.period_s for p, b in zip(position, self.before, strict=True)]
            self.speed = [0.4 * s + 0.6 * m for s, m in zip(self.speed, moved, strict=True)]
        self.before = position
        terms = zip(KP, KD, position, goal, self.speed, WEIGHT, strict=True)
        return [gain * (kp * (g - p) - kd * s) + w for kp, kd, p, g, s, w in terms]
