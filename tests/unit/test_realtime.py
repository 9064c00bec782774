"""Scheduling settings: applied where the system permits them, without effect elsewhere."""

import multiprocessing
import os
import struct
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from hilrig_runtime.timing import realtime


def _granted(connection: Connection) -> None:
    import ctypes
    import platform
    import threading

    realtime.set_short_slice()
    slices = []

    def look() -> None:
        attributes = ctypes.create_string_buffer(realtime._SCHED_ATTR.size)
        number = realtime._SCHED_SETATTR[platform.machine()] + 1
        ctypes.CDLL(None).syscall(number, 0, attributes, len(attributes), 0)
        slices.append(struct.unpack_from("=IIQiIQ", attributes.raw)[5])

    look()
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    slack = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)
    connection.send((slices, slack, sys.getswitchinterval()))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has timer slack and slices")
def test_threads_get_short_slices_and_small_timer_slack() -> None:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_granted, args=(theirs,))
    process.start()
    assert ours.poll(20)
    slices, slack, interval = ours.recv()
    process.join(10)
    assert slack == 1
    assert interval == pytest.approx(0.0005)
    release = tuple(int(part) for part in os.uname().release.split(".")[:2])
    if release >= (6, 12):
        assert slices == [realtime.SLICE_NS, realtime.SLICE_NS]


def _shares_its_core(connection: Connection) -> None:
    """Half of the time another process has the only core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    delay = realtime.RunDelay()
    child = os.fork()
    end = time.monotonic() + 0.2
    while time.monotonic() < end:
        pass
    if not child:
        os._exit(0)
    shared_ns = delay.take()
    os.waitpid(child, 0)
    delay.take()
    time.sleep(0.02)  # no time without a processor
    connection.send((shared_ns, delay.take()))


@pytest.mark.skipif(not Path("/proc/thread-self/schedstat").exists(), reason="this kernel does not count run delays")
def test_run_delay_is_the_time_without_a_processor() -> None:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_shares_its_core, args=(theirs,))
    process.start()
    assert ours.poll(20)
    shared_ns, slept_ns = ours.recv()
    process.join(10)
    assert shared_ns > 50_000_000
    # A sleep is no time without a processor; waking up is.
    assert slept_ns < shared_ns


def _asked_for_realtime(connection: Connection) -> None:
    import threading

    granted = realtime.go_realtime(1)
    policies = [os.sched_getscheduler(0)]
    thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
    thread.start()
    thread.join()
    connection.send((granted, policies, realtime.realtime_priority()))


def _asked_without_the_right(connection: Connection) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    os.setuid(65534)
    _asked_for_realtime(connection)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the policy")
@pytest.mark.parametrize("target", [_asked_for_realtime, _asked_without_the_right])
def test_realtime_policy_applies_to_all_threads(target: Callable[[Connection], None]) -> None:
    if target is _asked_without_the_right and os.geteuid() != 0:
        pytest.skip("only root can give the right away")
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=target, args=(theirs,))
    process.start()
    assert ours.poll(20)
    granted, policies, priority = ours.recv()
    process.join(10)
    if target is _asked_without_the_right:
        assert not granted
    assert policies == [os.SCHED_FIFO if granted else os.SCHED_OTHER] * 2
    assert priority == (1 if granted else 0)


def _one_ahead(connection: Connection) -> None:
    import threading

    priorities = []

    def look() -> None:
        priorities.append(realtime.realtime_priority())

    def receive() -> None:
        with realtime.raise_priority():
            look()
            thread = threading.Thread(target=look)
            thread.start()
            thread.join()
        look()

    receive()
    granted = realtime.go_realtime(1)
    receive()
    connection.send((granted, priorities))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the policy")
def test_raise_priority_only_under_realtime_policy() -> None:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_one_ahead, args=(theirs,))
    process.start()
    assert ours.poll(20)
    granted, priorities = ours.recv()
    process.join(10)
    assert priorities == [0, 0, 0, 2, 2, 1] if granted else [0] * 6


def _stepped_back(connection: Connection) -> None:
    realtime.lower_priority()
    connection.send(os.getpriority(os.PRIO_PROCESS, 0))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no nice values")
def test_recorder_lowers_its_priority() -> None:
    ours, theirs = multiprocessing.Pipe()
    before = os.getpriority(os.PRIO_PROCESS, 0)
    process = multiprocessing.get_context("spawn").Process(target=_stepped_back, args=(theirs,))
    process.start()
    assert ours.poll(20)
    assert ours.recv() == min(19, before + realtime.BACKGROUND_NICE)
    process.join(10)


def test_unknown_architecture_is_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    interval = sys.getswitchinterval()
    try:
        realtime.set_short_slice()
    finally:
        sys.setswitchinterval(interval)
