"""Where the ticks of a live rig are, heard from its step counter."""

import time

import pytest

from hilrig_runtime.errors import OperationError
from hilrig_study.live.live_loop import listen_for_ticks

STEP_NS = 20_000_000


class Counter:
    """A step counter that is asked over a network, which holds a request up before each tick."""

    def __init__(self, *, stands: bool = False) -> None:
        self.begin_ns = time.monotonic_ns() - STEP_NS // 2
        self._stands = stands
        self._held_up = 0

    def step(self) -> int:
        now_ns = time.monotonic_ns()
        to_tick_ns = STEP_NS - (now_ns - self.begin_ns) % STEP_NS
        if 6_000_000 < to_tick_ns < 9_000_000:
            # It is asked long before a tick, and answered after it.
            self._held_up += 1
            time.sleep((to_tick_ns + 100_000) * 1e-9)
        return 0 if self._stands else (time.monotonic_ns() - self.begin_ns) // STEP_NS


def test_a_request_that_is_held_up_does_not_move_the_ticks() -> None:
    counter = Counter()
    tick_ns = listen_for_ticks(counter, STEP_NS)  # type: ignore[arg-type]
    assert counter._held_up > 3
    after_ns = (tick_ns - counter.begin_ns) % STEP_NS
    # Never early; of 25 ticks one is seen soon.
    assert after_ns < STEP_NS // 4


def test_a_counter_that_stands_still_is_an_error() -> None:
    with pytest.raises(OperationError, match="does not step"):
        listen_for_ticks(Counter(stands=True), STEP_NS)  # type: ignore[arg-type]
