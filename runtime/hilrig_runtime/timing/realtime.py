"""Scheduling settings of the kernel and of the interpreter for punctual wake-ups.

If the system permits it, the services that close the loop run with the real-time policy SCHED_FIFO and preempt every
ordinary program. This needs a privilege (root, CAP_SYS_NICE or a limit `rtprio`); the other settings need none. By
default Linux rounds a sleep up by 50 µs (timer slack), and a thread that wakes up waits for the running thread's time
slice, some milliseconds; a thread with a short slice is scheduled earlier and runs for a shorter time. On two cores
with three busy processes, these settings reduced the lateness of a loop from 1.6 ms to 30 µs at the 95th percentile. On
other systems than Linux they do nothing.
"""

import contextlib
import ctypes
import gc
import os
import platform
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

REALTIME_PRIORITIES: Final = {"sim": 2, "edge": 1}
"""Priorities of the services that close the loop, 1 to 99: a tick preempts a request, and other real-time threads of
the system preempt both."""
SLICE_NS: Final = 100_000
"""Shortest time slice of Linux, ns."""
BACKGROUND_NICE: Final = 5

_PR_SET_TIMERSLACK: Final = 29
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
_SCHED_ATTR: Final = struct.Struct("=IIQiIQQQ")
"""`struct sched_attr` of sched_setattr(2): size, policy, flags, nice, priority, runtime, deadline, period."""


def go_realtime(priority: int) -> bool:
    """Set the real-time policy SCHED_FIFO for this thread and the threads that it starts from now on.

    Return whether the system permits it. Linux still reserves a share of each processor for ordinary programs.
    """
    if sys.platform != "linux":
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


def realtime_priority() -> int:
    """Return the real-time priority of this thread; 0: it has the ordinary policy."""
    if sys.platform != "linux":
        return 0
    # 0 for the ordinary policies.
    return os.sched_getparam(0).sched_priority


@contextlib.contextmanager
def raise_priority() -> Iterator[None]:
    """Raise the real-time priority of this thread, and of the threads that it starts, by one: for receiver threads.

    SCHED_FIFO threads of equal priority do not preempt each other, so a busy loop would delay its own receiver thread.
    Does nothing under the ordinary policy.
    """
    priority = realtime_priority()
    if not priority:
        yield
        return
    go_realtime(priority + 1)
    try:
        yield
    finally:
        go_realtime(priority)


def set_short_slice() -> None:
    """Request punctual wake-ups for this thread and the threads that it starts from now on; needs no privilege."""
    # Callback threads share the interpreter with the loop: switch ten times as often as by default.
    sys.setswitchinterval(0.0005)
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    number = _SCHED_SETATTR.get(platform.machine())
    # Under a real-time policy this field has another meaning, and the policy was set explicitly.
    if number is not None and os.sched_getscheduler(0) == os.SCHED_OTHER:
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, 0, nice, 0, SLICE_NS, 0, 0)
        # Before Linux 6.12 the slice is ignored or refused, without other effects.
        libc.syscall(number, 0, attributes, 0)


def lower_priority() -> None:
    """Lower the priority of this process below the services that close a loop; its input is queued."""
    if sys.platform == "win32":
        return
    os.nice(BACKGROUND_NICE)
    # Linux schedules processes in groups, one per session, each with its own nice value (autogroup).
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(BACKGROUND_NICE))


class RunDelay:
    """Time in which a thread was ready to run and had no processor, because other threads of the host had it.

    Create and read it in that thread. The time in which a hypervisor gives the host no processor is not contained.
    """

    def __init__(self) -> None:
        self._last_ns = _run_delay_ns()

    def take(self) -> int:
        """Return the time since the last call, ns; 0: none, or unknown on this system."""
        last_ns, self._last_ns = self._last_ns, _run_delay_ns()
        return max(0, self._last_ns - last_ns)


def _run_delay_ns() -> int:
    """Time since the start of this thread, ns, from its `schedstat`; 0: unknown on this system."""
    if sys.platform == "linux":
        # A process that has reached its limit of open files must keep running; a kernel may have no such statistics.
        with contextlib.suppress(OSError), open("/proc/thread-self/schedstat", "rb") as schedstat:  # noqa: PTH123  # in a real-time loop
            return int(schedstat.read().split()[1])
    return 0


def freeze_gc() -> None:
    """Collect garbage once and exclude the existing objects from later collections, so that these are shorter."""
    gc.collect()
    gc.freeze()
