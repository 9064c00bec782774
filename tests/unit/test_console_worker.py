"""Worker process of the console: results, errors, restart after a crash, shutdown; and the recording catalog."""

import asyncio
import json
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.requests import Request
from starlette.responses import JSONResponse

from hilrig_console import worker as worker_module
from hilrig_console.app import Console
from hilrig_console.catalog import ListWorker, RecordingCatalog
from hilrig_console.worker import Worker
from hilrig_runtime.errors import InputError, OperationError
from support.recordings import Script, record
from support.waiting import eventually


class Counter:
    """Object whose methods are called in the worker process."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.calls = 0

    def count(self) -> tuple[str, int, int]:
        self.calls += 1
        return self.name, self.calls, os.getpid()

    def raise_input_error(self) -> None:
        raise InputError("invalid request")

    def raise_value_error(self) -> None:
        raise ValueError("programming error")

    def crash(self) -> None:
        os._exit(1)

    def sleep(self) -> None:
        time.sleep(600)  # killed by the test


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_worker_keeps_state_and_restarts_after_crash() -> None:
    worker = Worker(Counter, "Ada")
    name, calls, pid = worker.call("count", timeout_s=30)
    assert (name, calls) == ("Ada", 1)
    assert worker.call("count", timeout_s=30) == ("Ada", 2, pid)
    with pytest.raises(InputError, match="invalid request"):
        worker.call("raise_input_error", timeout_s=30)
    with pytest.raises(OperationError, match="see the log of the console"):
        worker.call("raise_value_error", timeout_s=30)
    assert worker.call("count", timeout_s=30) == ("Ada", 3, pid)
    with pytest.raises(OperationError, match="ended unexpectedly"):
        worker.call("crash", timeout_s=30)
    _, calls, second = worker.call("count", timeout_s=30)
    assert calls == 1
    assert second != pid
    with pytest.raises(OperationError, match="no result within 0 s"):
        worker.call("sleep", timeout_s=0.1)
    assert not is_running(second)
    worker.close()
    with pytest.raises(OperationError):
        worker.call("count", timeout_s=30)


def test_close_aborts_running_call() -> None:
    worker, errors = Worker(Counter, "Ada"), list[str]()
    _, _, pid = worker.call("count", timeout_s=30)

    def call() -> None:
        try:
            worker.call("sleep", timeout_s=600)
        except OperationError as error:
            errors.append(str(error))

    caller = threading.Thread(target=call)
    caller.start()
    worker.close()
    caller.join(10)
    assert len(errors) == 1
    assert eventually(lambda: not is_running(pid))


def test_close_during_start_ends_process(monkeypatch: pytest.MonkeyPatch) -> None:
    worker, started = Worker(Counter, "Ada"), list[Any]()
    start = worker_module._SPAWN.Process.start

    def start_and_close(process: Any) -> None:
        worker.close()
        start(process)
        worker.close()
        started.append(process)

    monkeypatch.setattr(worker_module._SPAWN.Process, "start", start_and_close)
    with pytest.raises(OperationError, match="the worker is being closed"):
        worker.call("count", timeout_s=30)
    assert started[0].exitcode is not None


def test_catalog_serves_only_listed_existing_files(tmp_path: Path) -> None:
    with RecordingCatalog(tmp_path) as catalog:
        path = record(tmp_path / "run.mcap", Script(seconds=0.5))
        with pytest.raises(InputError, match=r"unknown recording 'run\.mcap'"):
            catalog.file("run.mcap")
        catalog.refresh()
        assert catalog.version == 1
        assert (catalog.file("run.mcap"), catalog.search("")["total"]) == (path, 1)
        assert [catalog.search(query)["found"] for query in ("RUN", "run missing")] == [1, 0]
        path.unlink()
        with pytest.raises(InputError):
            catalog.file("run.mcap")
        for other in ("../run.mcap", str(path), "", "."):
            with pytest.raises(InputError):
                catalog.file(other)


def test_catalog_lists_and_serves_any_file_name(tmp_path: Path) -> None:
    names = [b"\xe9.mcap", b"a\nb\r\x1b[2J.mcap", "a\u202epacm.mcap".encode(), b"n" * 250 + b".mcap"]
    paths = [tmp_path / os.fsdecode(name) for name in names]
    good = record(tmp_path / "run.mcap", Script(seconds=0.5))
    for path in paths:
        os.link(good, path)
    with RecordingCatalog(tmp_path) as catalog:
        catalog.refresh()
        # JSON in UTF-8, as the page gets it.
        runs = json.loads(bytes(JSONResponse(catalog.search("")).body))["runs"]
        assert {catalog.file(run["path"]) for run in runs} == {good, *paths}
        assert all(text.isprintable() for run in runs for text in (run["path"], run["name"], run["error"]))
        for run in runs:
            request = Request({"type": "http", "path_params": {"path": run["path"]}})
            download: Any = asyncio.run(Console._recording(SimpleNamespace(_catalog=catalog), request))  # type: ignore[arg-type]
            assert download.headers["content-disposition"].startswith("attachment; filename")
        paths[0].unlink()
        paths[0].symlink_to(paths[0])
        with pytest.raises(InputError, match=r"unknown recording '\\\\xe9\.mcap'"):
            catalog.file(r"\xe9.mcap")


def test_catalog_reports_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        ListWorker(tmp_path / "none").entries()
