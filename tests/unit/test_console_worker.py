"""A process that does what takes long: it gives values, says errors, is replaced when it dies, ends with its owner."""

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from hilrig_console import worker as worker_module
from hilrig_console.catalog import ListWorker, RecordingCatalog
from hilrig_console.worker import Worker
from hilrig_runtime.errors import InputError, OperationError
from support.recordings import Script, record
from support.waiting import eventually


class Clerk:
    def __init__(self, name: str) -> None:
        self.name = name
        self.calls = 0

    def greet(self) -> tuple[str, int, int]:
        self.calls += 1
        return self.name, self.calls, os.getpid()

    def refuse(self) -> None:
        raise InputError("that is not how it is done")

    def stumble(self) -> None:
        raise ValueError("a mistake in the program")

    def die(self) -> None:
        os._exit(1)

    def sleep(self) -> None:
        time.sleep(600)


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_remembers_says_what_is_wrong_and_is_replaced_when_it_dies() -> None:
    worker = Worker(Clerk, "Ada")
    name, calls, pid = worker.call("greet", timeout_s=30)
    assert (name, calls) == ("Ada", 1)
    assert worker.call("greet", timeout_s=30) == ("Ada", 2, pid)
    with pytest.raises(InputError, match="that is not how it is done"):
        worker.call("refuse", timeout_s=30)
    with pytest.raises(OperationError, match="the log says why"):
        worker.call("stumble", timeout_s=30)
    assert worker.call("greet", timeout_s=30) == ("Ada", 3, pid)
    with pytest.raises(OperationError, match="ended"):
        worker.call("die", timeout_s=30)
    _, calls, second = worker.call("greet", timeout_s=30)
    assert calls == 1
    assert second != pid
    with pytest.raises(OperationError, match="longer than 0 s"):
        worker.call("sleep", timeout_s=0.1)
    assert not is_there(second)
    worker.close()
    with pytest.raises(OperationError):
        worker.call("greet", timeout_s=30)


def test_closing_ends_a_call_that_goes_on() -> None:
    worker, said = Worker(Clerk, "Ada"), list[str]()
    _, _, pid = worker.call("greet", timeout_s=30)

    def ask() -> None:
        try:
            worker.call("sleep", timeout_s=600)
        except OperationError as error:
            said.append(str(error))

    asking = threading.Thread(target=ask)
    asking.start()
    worker.close()
    asking.join(10)
    assert len(said) == 1
    assert eventually(lambda: not is_there(pid))


def test_a_worker_that_is_closed_while_it_starts_ends_too(monkeypatch: pytest.MonkeyPatch) -> None:
    worker, begun = Worker(Clerk, "Ada"), list[Any]()
    start = worker_module._SPAWN.Process.start

    def start_and_close(process: Any) -> None:
        worker.close()
        start(process)
        worker.close()
        begun.append(process)

    monkeypatch.setattr(worker_module._SPAWN.Process, "start", start_and_close)
    with pytest.raises(OperationError, match="it is being closed"):
        worker.call("greet", timeout_s=30)
    assert begun[0].exitcode is not None


def test_only_what_is_listed_and_still_there_is_given_out(tmp_path: Path) -> None:
    with RecordingCatalog(tmp_path) as catalog:
        path = record(tmp_path / "run.mcap", Script(seconds=0.5))
        with pytest.raises(InputError, match=r"no recording 'run\.mcap' is listed"):
            catalog.file("run.mcap")
        catalog.refresh()
        assert catalog.version == 1
        assert (catalog.file("run.mcap"), catalog.search("")["total"]) == (path, 1)
        assert [catalog.search(words)["found"] for words in ("RUN", "run nobody's")] == [1, 0]
        path.unlink()
        with pytest.raises(InputError):
            catalog.file("run.mcap")
        for other in ("../run.mcap", str(path), "", "."):
            with pytest.raises(InputError):
                catalog.file(other)


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        ListWorker(tmp_path / "none").entries()
