"""The sync worker: which files are synced, when, and how files are finished."""

import errno
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilrig_recorder.storage.sync_worker import SyncWorker
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.waiting import LONG_TIMEOUT_S, eventually


@dataclass(eq=False)
class FakeWriter:
    """The members of a writer that the sync worker uses."""

    size: int = 0
    path: Path = Path("run.mcap")
    temporary_path: Path = Path("run.mcap.part")
    sync_s: float = 0.0
    synced: list[int] = field(default_factory=list)
    done: list[str] = field(default_factory=list)
    failure: OSError | None = None

    def sync(self) -> None:
        if self.failure is not None:
            raise self.failure
        time.sleep(self.sync_s)  # a slow disk
        self.synced.append(self.size)

    def finish(self) -> None:
        if self.failure is not None:
            raise self.failure
        self.done.append("finish")

    def publish(self, *, durably: bool) -> None:
        self.done.append("publish durably" if durably else "publish")

    def close(self) -> None:
        self.done.append("close")


class Results:
    """The calls of the worker's callbacks."""

    def __init__(self) -> None:
        self.sync_errors: list[Any] = []
        self.finished: list[Any] = []
        self.threads: set[threading.Thread] = set()

    def on_sync_error(self, writer: Any, error: OSError) -> None:
        self.sync_errors.append((writer, error))

    def on_finished(self, writer: Any, error: OSError | None) -> None:
        self.finished.append((writer, error))
        self.threads.add(threading.current_thread())


@contextmanager
def running_worker() -> Iterator[tuple[Any, Results]]:
    results = Results()
    worker = SyncWorker(SYSTEM_CLOCK, results.on_sync_error, results.on_finished)
    try:
        yield worker, results
    finally:
        assert worker.close(5.0)


def test_only_files_with_new_data_are_synced() -> None:
    writer, idle = FakeWriter(), FakeWriter()
    with running_worker() as (worker, results):
        worker.follow(writer)
        worker.follow(idle)
        for size in (1000, 2000):
            writer.size = size
            begin_s = time.monotonic()
            eventually(lambda: writer.size in writer.synced)
            duration_s = time.monotonic() - begin_s
        # There were two writes.
        assert writer.synced == [1000, 2000]
        assert idle.synced == []
        assert duration_s < 5
    assert results.sync_errors == []


def test_file_is_finished_and_renamed_on_the_worker_thread() -> None:
    writer = FakeWriter()
    with running_worker() as (worker, results):
        worker.follow(writer)
        worker.finish(writer, writer.finish)
        eventually(lambda: results.finished)
        assert results.finished == [(writer, None)]
        assert writer.done == ["finish", "publish durably"]
        assert results.threads != {threading.current_thread()}
        # A finished file is not synced any more.
        writer.size = 1
        other = FakeWriter(size=1)
        worker.follow(other)
        eventually(lambda: other.synced)
        assert writer.synced == []


def test_unfinishable_file_is_closed_and_reported() -> None:
    writer = FakeWriter(failure=OSError(errno.EIO, "Input/output error"), size=1)
    with running_worker() as (worker, results):
        worker.follow(writer)
        eventually(lambda: results.sync_errors)
        worker.finish(writer, writer.finish)
        eventually(lambda: results.finished)
    assert results.sync_errors == [(writer, writer.failure)]
    assert results.finished == [(writer, writer.failure)]
    assert writer.done == ["close"]


def test_slow_disk_alternates_syncing_and_finishing() -> None:
    writers = [FakeWriter(size=1, sync_s=0.02) for _ in range(200)]
    ending = [FakeWriter() for _ in range(5)]
    with running_worker() as (worker, results):
        for writer in writers:
            worker.follow(writer)
        eventually(lambda: any(writer.synced for writer in writers))
        for writer in ending:
            worker.finish(writer, writer.finish)
        eventually(lambda: len(results.finished) == len(ending))
        assert not all(writer.synced for writer in writers)


def test_sync_delay_is_measured() -> None:
    writers = [FakeWriter(size=1, sync_s=0.1) for _ in range(3)]
    with running_worker() as (worker, _):
        for writer in writers:
            worker.follow(writer)
        eventually(lambda: worker.sync_delay_s > 0.1, every_s=0.01)
        eventually(lambda: all(writer.synced for writer in writers))
        # No new data.
        eventually(lambda: worker.sync_delay_s < 0.1)


def test_shutdown_renames_every_file_without_sync_if_late() -> None:
    slow = FakeWriter()
    fast = FakeWriter()
    results = Results()
    worker = SyncWorker(SYSTEM_CLOCK, results.on_sync_error, results.on_finished)
    started = threading.Event()

    def finish_slowly() -> None:
        started.set()
        time.sleep(0.3)  # a slow disk: longer than the time-out of the shutdown

    worker.finish(slow, finish_slowly)  # type: ignore[arg-type]
    worker.finish(fast, fast.finish)  # type: ignore[arg-type]
    assert started.wait(LONG_TIMEOUT_S)
    assert worker.close(0.05)
    assert (slow.done, fast.done) == (["publish"], ["finish", "publish"])
