"""Catalog of the recordings of a lab: a list that is refreshed periodically, and reports on demand.

Only listed files are served. Listing and reporting run in worker processes, so that they do not block the page.
"""

import tempfile
import threading
import time
from collections import OrderedDict
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from hilrig_console.worker import Worker
from hilrig_recorder.mcap_format.file_names import recording_stem
from hilrig_replay.analysis.index import IN_PROGRESS, RunEntry, RunIndex
from hilrig_replay.io.segments import RunFiles
from hilrig_runtime.bus.api import Handle
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.escaping import printable

LIST_PERIOD_S: Final = 2.0
"""Shortest period of listing the folder while a browser is connected, s."""
LIST_REST_FACTOR: Final = 10
"""Pause after listing, as a multiple of its CPU time."""
MEASURE_BUDGET_S: Final = 0.5
"""Time limit per listing for measuring the latency of recordings, s; the next listing continues."""
LIST_TIMEOUT_S: Final = 120.0
REPORT_TIMEOUT_S: Final = 180.0
MAX_CACHED_REPORTS: Final = 50
"""Upper limit of cached reports; a report has 0.5 to 4 MB."""
MAX_LISTED: Final = 100
"""Upper limit of recordings in one reply."""


class ListWorker:
    """Lists the recordings of a folder, in a worker process."""

    def __init__(self, folder: Path) -> None:
        self._index = RunIndex(folder)

    def entries(self) -> tuple[list[RunEntry], float]:
        """Return all recordings, newest first, and the CPU time of the listing, s.

        Latencies are measured within `MEASURE_BUDGET_S`.

        Raises:
            InputError: the folder does not exist.
        """
        start_s = time.process_time()
        entries = self._index.load()
        spent_s, listed_s = time.process_time() - start_s, time.monotonic()
        for number, entry in enumerate(entries):
            if time.monotonic() - listed_s > MEASURE_BUDGET_S:
                break
            (entries[number],) = self._index.measure([entry])
        self._index.save()
        return entries, spent_s


class ReportWorker:
    """Writes reports of recordings, in a worker process."""

    def write(self, recording: RunFiles, page: Path) -> None:
        """Write the report of a run.

        Raises:
            InputError: the recording can't be read.
        """
        # Imported here: each report runs in a new process, and the process of the console must not load matplotlib.
        from hilrig_replay.report.report import build_report

        page.write_text(build_report([recording]).html, encoding="utf-8")


class RecordingCatalog(Handle):
    """Recordings below a folder. The methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.version = 0
        """Changes when the list changes."""
        self.error = "the recordings are being listed"
        """Reason why the list is missing or outdated; empty: none."""
        self._entries: list[RunEntry] = []
        self._due_s = 0.0
        self._list_worker = Worker(ListWorker, folder)
        self._report_worker = Worker(ReportWorker)
        self._reporting = threading.Lock()
        self._reports: OrderedDict[tuple[Any, ...], Path] = OrderedDict()
        self._cache = tempfile.TemporaryDirectory(prefix="hilrig-console-", ignore_cleanup_errors=True)

    def refresh(self) -> None:
        """List the folder again if the period has passed."""
        if time.monotonic() < self._due_s:
            return
        spent_s, message = 0.0, ""
        try:
            entries, spent_s = self._list_worker.call("entries", timeout_s=LIST_TIMEOUT_S)
        except InputError as error:
            entries, message = [], str(error)
        except HilrigError as error:
            entries, message = self._entries, f"can't list the recordings: {error}"
        self._due_s = time.monotonic() + max(LIST_PERIOD_S, LIST_REST_FACTOR * spent_s)
        if (entries, message) != (self._entries, self.error):
            self._entries, self.error = entries, message
            self.version += 1

    def search(self, query: str) -> dict[str, Any]:
        """Return the newest recordings that contain every term of the query, as JSON values.

        Searched are rig, session, controller and ending.
        """
        terms = query.lower().split()
        found = [entry for entry in self._entries if all(term in _search_text(entry) for term in terms)]
        return {
            "version": self.version,
            "error": printable(self.error),
            "total": len(self._entries),
            "found": len(found),
            "runs": [_row(entry) for entry in found[:MAX_LISTED]],
        }

    def file(self, path: str) -> Path:
        """Return the file of a listed run by its path in the list, in which control characters are escaped.

        Raises:
            InputError: the file is not listed or does not exist anymore.
        """
        listed = {printable(one): one for entry in self._entries for one in entry.paths}
        if path in listed:
            # RuntimeError: a loop of symbolic links.
            with suppress(OSError, RuntimeError):
                found = (self.folder / listed[path]).resolve()
                if found.is_relative_to(self.folder.resolve()) and found.is_file():
                    return found
        raise InputError(f"unknown recording {path!r}")

    def report(self, path: str) -> Path:
        """Return the report page of a listed run, by its first file; it is created if it is not cached.

        Raises:
            HilrigError: the recording is unknown, or its report can't be created.
        """
        listed = next((entry.paths for entry in self._entries if printable(entry.path) == path), None)
        recording = tuple(self.file(printable(one)) for one in listed) if listed else (self.file(path),)
        states = [one.stat() for one in recording]
        key = (recording, *(number for info in states for number in (info.st_size, info.st_mtime_ns)))
        with self._reporting:
            page = self._reports.get(key)
            if page is not None:
                self._reports.move_to_end(key)
                return page
            page = Path(tempfile.mkstemp(dir=self._cache.name, suffix=".html")[1])
            try:
                self._report_worker.call("write", recording, page, timeout_s=REPORT_TIMEOUT_S)
            except HilrigError:
                page.unlink()
                raise
            finally:
                # Ends the process to free its memory.
                self._report_worker.stop()
            self._reports[key] = page
            if len(self._reports) > MAX_CACHED_REPORTS:
                self._reports.popitem(last=False)[1].unlink(missing_ok=True)
            return page

    def close(self) -> None:
        """End the worker processes and delete the reports."""
        self._list_worker.close()
        self._report_worker.close()
        self._cache.cleanup()


def _search_text(entry: RunEntry) -> str:
    return f"{entry.path} {entry.rig} {entry.controller} {entry.ended} {entry.error}".lower()


def _row(entry: RunEntry) -> dict[str, Any]:
    row = {name: _shown(value) for name, value in asdict(entry).items()}
    for name in ("mtime_ns", "start_wall_ns", "unfit_reasons", "measured", "lab", "segment", "span"):
        del row[name]
    row["start_ms"] = entry.start_wall_ns // 1_000_000
    row["name"] = printable(recording_stem(Path(entry.path).name))
    row["unfit"] = "; ".join(reason.text for reason in entry.unfit_reasons)
    row["open"] = entry.ended == IN_PROGRESS
    return row


def _shown(value: Any) -> Any:
    """A value with its texts escaped: UTF-8 has no undecodable file names."""
    if isinstance(value, str):
        return printable(value)
    return [_shown(one) for one in value] if isinstance(value, list | tuple) else value
