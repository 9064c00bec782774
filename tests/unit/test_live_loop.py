"""Measurement of the tick phase of a live rig from its step counter."""

import time

import pytest

from hilrig_runtime.errors import OperationError
from hilrig_study.live.live_loop import measure_tick_phase

STEP_NS = 20_000_000


class Counter:
    """Step counter behind a simulated network that delays a request before each tick."""

    def __init__(self, *, stopped: bool = False) -> None:
        self.start_ns = time.monotonic_ns() - STEP_NS // 2
        self._stopped = stopped
        self._delayed = 0

    def step(self) -> int:
        now_ns = time.monotonic_ns()
        to_tick_ns = STEP_NS - (now_ns - self.start_ns) % STEP_NS
        if 6_000_000 < to_tick_ns < 9_000_000:
            # The request is sent long before a tick and answered after it.
            self._delayed += 1
            time.sleep((to_tick_ns + 100_000) * 1e-9)
        return 0 if self._stopped else (time.monotonic_ns() - self.start_ns) // STEP_NS


def test_delayed_request_does_not_shift_tick_phase() -> None:
    counter = Counter()
    tick_ns = measure_tick_phase(counter, STEP_NS)  # type: ignore[arg-type]
    assert counter._delayed > 3
    after_ns = (tick_ns - counter.start_ns) % STEP_NS
    # Never early; at least one of 25 ticks is observed promptly.
    assert after_ns < STEP_NS // 4


def test_rejects_stopped_step_counter() -> None:
    with pytest.raises(OperationError, match="does not step"):
        measure_tick_phase(Counter(stopped=True), STEP_NS)  # type: ignore[arg-type]
