"""The positions that were written to a controller, by the step number in its registers: finds what torques answer.

Pure: time is passed in.
"""

from typing import Final, NamedTuple

from hilrig_modbus_edge.device.client import NO_STATE, PollTimes, ServedState

MAX_WRITES: Final = 1024
"""Number of remembered writes: 20 s at a step of 20 ms. A program that copies an older number is not recognized."""
STEP_MASK: Final = 0xFFFF
"""The step number in a register has 16 bits."""


class _Write(NamedTuple):
    served: ServedState
    acknowledged_ns: int
    """0: not acknowledged."""


class WrittenPositions:
    """Writes of positions, the newest last."""

    def __init__(self) -> None:
        self._by_step: dict[int, _Write] = {}
        self._newest = _Write(NO_STATE, 0)
        """The newest acknowledged write."""
        self._sent = self._newest
        """The newest write that was sent."""

    @property
    def any_acknowledged(self) -> bool:
        """Whether a write was acknowledged."""
        return self._newest.acknowledged_ns != 0

    @property
    def newest_echo(self) -> int:
        """Step number of the newest acknowledged write, as a program copies it."""
        return self._newest.served[0][1] & STEP_MASK

    def add(self, served: ServedState) -> None:
        """Add a write that is about to be sent; `served` has the state and the time of sending."""
        step = served[0][1] & STEP_MASK
        self._by_step.pop(step, None)
        self._sent = self._by_step[step] = _Write(served, 0)
        if len(self._by_step) > MAX_WRITES:
            del self._by_step[next(iter(self._by_step))]

    def acknowledge(self, served: ServedState, now_ns: int) -> None:
        """Record that this write was acknowledged; ns, monotonic clock."""
        self._newest = self._sent = self._by_step[served[0][1] & STEP_MASK] = _Write(served, now_ns)

    def basis_of_echo(
        self, echo: int, read_sent_ns: int, stale_read_sent_ns: int
    ) -> tuple[ServedState, PollTimes] | None:
        """Return the basis of torques beside an echo; None: its step number was not written.

        Args:
            echo: the echo.
            read_sent_ns: time at which the request was sent that read it, ns, monotonic clock.
            stale_read_sent_ns: the same of the newest request that still read the echo before.
        """
        write = self._by_step.get(echo)
        if write is None:
            return None
        # A write that was not acknowledged was received before the read was sent at the latest.
        acknowledged_ns = write.acknowledged_ns or read_sent_ns
        stale_ns = stale_read_sent_ns if stale_read_sent_ns > write.served[1] else 0
        return write.served, PollTimes(acknowledged_ns, read_sent_ns, stale_ns, False)

    def newest_basis(self, read_sent_ns: int) -> tuple[ServedState, PollTimes]:
        """Return the newest state that torques can answer that are read with a request that is sent at a time.

        The controller may have executed a write that it has not acknowledged.
        """
        write = self._sent
        return write.served, PollTimes(write.acknowledged_ns or read_sent_ns, read_sent_ns, 0, True)
