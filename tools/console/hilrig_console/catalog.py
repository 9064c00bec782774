"""The recordings of a lab: their list, kept fresh, and a report of each on demand.

Only what stands in the list is given out. Listing and reporting are done by processes of their own, so that neither
holds up the page.
"""

import tempfile
import threading
import time
from collections import OrderedDict
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from hilrig_console.worker import Worker
from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, PART_SUFFIX
from hilrig_replay.analysis.index import IN_PROGRESS, RunEntry, RunIndex
from hilrig_runtime.errors import HilrigError, InputError

PERIOD_S: Final = 2.0
"""Between looks at the folder, while somebody looks at the page."""
REST: Final = 10
"""So many times as long as the work of a look took is rested from it."""
MEASURED_S: Final = 0.5
"""How long a look may read recordings for their latency; the next one goes on."""
LIST_TIMEOUT_S: Final = 120.0
REPORT_TIMEOUT_S: Final = 180.0
REPORTS: Final = 50
"""Reports that are kept, count; one takes some 300 KB."""
SHOWN: Final = 100
"""Recordings of one answer."""


class Librarian:
    """What is done in the process that lists."""

    def __init__(self, folder: Path) -> None:
        self._index = RunIndex(folder)

    def entries(self) -> tuple[list[RunEntry], float]:
        """Every recording, newest first, with latencies as far as the time allowed; and the processor time taken, s.

        Raises:
            InputError: there is no such folder.
        """
        begun_s = time.process_time()
        entries = self._index.load()
        spent_s, listed_s = time.process_time() - begun_s, time.monotonic()
        for number, entry in enumerate(entries):
            if time.monotonic() - listed_s > MEASURED_S:
                break
            (entries[number],) = self._index.measure([entry])
        self._index.save()
        return entries, spent_s


class Reporter:
    """What is done in the process that reports."""

    def write(self, recording: Path, page: Path) -> None:
        """Write the report of a recording.

        Raises:
            InputError: the recording can't be reported.
        """
        # Each report has a process of its own, which loads what draws only then.
        from hilrig_replay.report.report import report

        page.write_text(report([recording]).html, encoding="utf-8")


class Shelf:
    """The recordings below a folder; a context manager. Its methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.version = 0
        """Changes when the list does."""
        self.trouble = "the recordings are being listed"
        """Why there is no list; empty: there is."""
        self._entries: list[RunEntry] = []
        self._by_path: dict[str, RunEntry] = {}
        self._due_s = 0.0
        self._librarian = Worker(Librarian, folder)
        self._reporter = Worker(Reporter)
        self._reporting = threading.Lock()
        self._reports: OrderedDict[tuple[str, int, int], Path] = OrderedDict()
        self._cache = tempfile.TemporaryDirectory(prefix="hilrig-console-", ignore_cleanup_errors=True)

    def look(self) -> None:
        """List the folder anew, if it is time."""
        if time.monotonic() < self._due_s:
            return
        spent_s, trouble = 0.0, ""
        try:
            entries, spent_s = self._librarian.call("entries", timeout_s=LIST_TIMEOUT_S)
        except InputError as error:
            entries, trouble = [], str(error)
        except HilrigError as error:
            entries, trouble = self._entries, f"the recordings can't be listed: {error}"
        self._due_s = time.monotonic() + max(PERIOD_S, REST * spent_s)
        if (entries, trouble) != (self._entries, self.trouble):
            self._entries, self.trouble = entries, trouble
            self._by_path = {entry.path: entry for entry in entries}
            self.version += 1

    def listed(self, words: str) -> dict[str, Any]:
        """The newest recordings whose rig, session, controller or ending has all of the words, as plain values."""
        wanted = words.lower().split()
        found = [entry for entry in self._entries if all(word in _text(entry) for word in wanted)]
        return {
            "version": self.version,
            "trouble": self.trouble,
            "total": len(self._entries),
            "found": len(found),
            "runs": [_row(entry) for entry in found[:SHOWN]],
        }

    def file(self, path: str) -> Path:
        """Where a listed recording is.

        Raises:
            InputError: it is not listed, or gone.
        """
        entry = self._by_path.get(path)
        found = None if entry is None else (self.folder / entry.path).resolve()
        if found is None or not found.is_relative_to(self.folder.resolve()) or not found.is_file():
            raise InputError(f"no recording {path!r} is listed")
        return found

    def report(self, path: str) -> Path:
        """The page of a listed recording; it is made if there is none yet.

        Raises:
            HilrigError: there is no such recording, or it can't be reported.
        """
        recording = self.file(path)
        info = recording.stat()
        key = (path, info.st_size, info.st_mtime_ns)
        with self._reporting:
            page = self._reports.get(key)
            if page is not None:
                self._reports.move_to_end(key)
                return page
            page = Path(tempfile.mkstemp(dir=self._cache.name, suffix=".html")[1])
            try:
                self._reporter.call("write", recording, page, timeout_s=REPORT_TIMEOUT_S)
            except HilrigError:
                page.unlink()
                raise
            finally:
                # Its memory is given back.
                self._reporter.end()
            self._reports[key] = page
            if len(self._reports) > REPORTS:
                self._reports.popitem(last=False)[1].unlink(missing_ok=True)
            return page

    def __enter__(self) -> "Shelf":
        return self

    def __exit__(self, *_: object) -> None:
        self._librarian.close()
        self._reporter.close()
        self._cache.cleanup()


def _text(entry: RunEntry) -> str:
    return f"{entry.path} {entry.rig} {entry.controller} {entry.ended} {entry.trouble}".lower()


def _row(entry: RunEntry) -> dict[str, Any]:
    row = asdict(entry)
    for name in ("mtime_ns", "start_wall_ns", "unfit_reasons", "measured", "lab"):
        del row[name]
    row["start_ms"] = entry.start_wall_ns // 1_000_000
    row["name"] = Path(entry.path).name.removesuffix(PART_SUFFIX).removesuffix(MCAP_SUFFIX)
    row["unfit"] = "; ".join(entry.unfit_reasons)
    row["open"] = entry.ended == IN_PROGRESS
    return row
