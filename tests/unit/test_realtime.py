"""What a process asks for its timing: granted where the system can, harmless where it can't."""

import multiprocessing
import os
import struct
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection

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
def test_the_thread_and_those_that_it_starts_get_short_slices_and_sharp_timers() -> None:
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
def test_the_real_time_policy_holds_for_all_threads_where_it_is_granted(target: Callable[[Connection], None]) -> None:
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
def test_who_receives_goes_one_ahead_and_back_under_the_real_time_policy_alone() -> None:
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
def test_what_records_steps_back_behind_what_closes_the_loop() -> None:
    ours, theirs = multiprocessing.Pipe()
    before = os.getpriority(os.PRIO_PROCESS, 0)
    process = multiprocessing.get_context("spawn").Process(target=_stepped_back, args=(theirs,))
    process.start()
    assert ours.poll(20)
    assert ours.recv() == min(19, before + realtime.BACKGROUND_NICE)
    process.join(10)


def test_an_unknown_machine_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    interval = sys.getswitchinterval()
    try:
        realtime.set_short_slice()
    finally:
        sys.setswitchinterval(interval)
