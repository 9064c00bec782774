"""What is synced, when, and how files end, on the disk's own thread."""

import errno
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilrig_recorder.storage.sync_worker import Disk
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.waiting import PATIENT_S, eventually


@dataclass(eq=False)
class FakeWriter:
    """As much of a writer as the disk's thread sees."""

    size: int = 0
    path: Path = Path("run.mcap")
    part: Path = Path("run.mcap.part")
    sync_s: float = 0.0
    synced: list[int] = field(default_factory=list)
    done: list[str] = field(default_factory=list)
    failure: OSError | None = None

    def sync(self) -> None:
        if self.failure is not None:
            raise self.failure
        time.sleep(self.sync_s)
        self.synced.append(self.size)

    def finish(self) -> None:
        if self.failure is not None:
            raise self.failure
        self.done.append("finish")

    def publish(self, *, durably: bool) -> None:
        self.done.append("publish durably" if durably else "publish")

    def close(self) -> None:
        self.done.append("close")


class Heard:
    """What the disk's thread says."""

    def __init__(self) -> None:
        self.troubles: list[Any] = []
        self.ended: list[Any] = []
        self.threads: set[threading.Thread] = set()

    def on_trouble(self, writer: Any, error: OSError) -> None:
        self.troubles.append((writer, error))

    def on_ended(self, writer: Any, error: OSError | None) -> None:
        self.ended.append((writer, error))
        self.threads.add(threading.current_thread())


@contextmanager
def disk() -> Iterator[tuple[Any, Heard]]:
    heard = Heard()
    thread = Disk(SYSTEM_CLOCK, heard.on_trouble, heard.on_ended)
    try:
        yield thread, heard
    finally:
        assert thread.close(5.0)


def test_what_was_written_is_synced_soon_and_only_then() -> None:
    writer, idle = FakeWriter(), FakeWriter()
    with disk() as (thread, heard):
        thread.follow(writer)
        thread.follow(idle)
        for size in (1000, 2000):
            writer.size = size
            begin_s = time.monotonic()
            eventually(lambda size=size: size in writer.synced)
            soon_s = time.monotonic() - begin_s
        # It was written to twice.
        assert writer.synced == [1000, 2000]
        assert idle.synced == []
        assert soon_s < 5
    assert heard.troubles == []


def test_a_file_ends_on_the_disk_s_thread_and_then_has_its_name() -> None:
    writer = FakeWriter()
    with disk() as (thread, heard):
        thread.follow(writer)
        thread.end(writer, writer.finish)
        eventually(lambda: heard.ended)
        assert heard.ended == [(writer, None)]
        assert writer.done == ["finish", "publish durably"]
        assert heard.threads != {threading.current_thread()}
        # Nobody syncs it any more.
        writer.size = 1
        other = FakeWriter(size=1)
        thread.follow(other)
        eventually(lambda: other.synced)
        assert writer.synced == []


def test_a_file_that_can_not_be_finished_is_let_go_and_told() -> None:
    writer = FakeWriter(failure=OSError(errno.EIO, "Input/output error"), size=1)
    with disk() as (thread, heard):
        thread.follow(writer)
        eventually(lambda: heard.troubles)
        thread.end(writer, writer.finish)
        eventually(lambda: heard.ended)
    assert heard.troubles == [(writer, writer.failure)]
    assert heard.ended == [(writer, writer.failure)]
    assert writer.done == ["close"]


def test_a_slow_disk_syncs_and_ends_files_in_turns() -> None:
    writers = [FakeWriter(size=1, sync_s=0.02) for _ in range(200)]
    ending = [FakeWriter() for _ in range(5)]
    with disk() as (thread, heard):
        for writer in writers:
            thread.follow(writer)
        eventually(lambda: any(writer.synced for writer in writers))
        for writer in ending:
            thread.end(writer, writer.finish)
        eventually(lambda: len(heard.ended) == len(ending))
        assert not all(writer.synced for writer in writers)


def test_how_long_it_takes_until_all_is_safe_is_known() -> None:
    writers = [FakeWriter(size=1, sync_s=0.1) for _ in range(3)]
    with disk() as (thread, _):
        for writer in writers:
            thread.follow(writer)
        eventually(lambda: thread.behind_s > 0.1, every_s=0.01)
        eventually(lambda: all(writer.synced for writer in writers))
        # Nothing is written any more.
        eventually(lambda: thread.behind_s < 0.1)


def test_at_the_end_every_file_gets_its_name_if_need_be_without_syncing() -> None:
    slow = FakeWriter()
    quick = FakeWriter()
    heard = Heard()
    thread = Disk(SYSTEM_CLOCK, heard.on_trouble, heard.on_ended)
    begun = threading.Event()

    def finish_slowly() -> None:
        begun.set()
        time.sleep(0.3)

    thread.end(slow, finish_slowly)  # type: ignore[arg-type]
    thread.end(quick, quick.finish)  # type: ignore[arg-type]
    assert begun.wait(PATIENT_S)
    assert thread.close(0.05)
    assert (slow.done, quick.done) == (["publish"], ["finish", "publish"])
