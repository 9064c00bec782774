"""`hilrig runs`: lists the recordings of a folder."""

import sys
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilrig_cli.options import AsJson, Config, format_size

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.text import Text

    from hilrig_replay.analysis.index import RunEntry


ABNORMAL_ENDINGS = ("disk full", "write failed", "keeper lost")
"""Endings that are shown with their reason."""
FILE_WIDTH = 200
"""Maximum number of characters per line of output that is not for a terminal."""
WIDE_TERMINAL_COLUMNS = 130
"""Minimum width of a terminal in which all columns are shown, characters."""


class SortKey(StrEnum):
    """Sort key of the list."""

    START = "start"
    RIG = "rig"
    DURATION = "duration"
    SIZE = "size"
    P50 = "p50"
    P99 = "p99"
    LOST = "lost"


def runs(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="FOLDER", help="Folder of the recordings; default: the lab's recorder.folder."),
    ] = None,
    config: Config = None,
    rig: Annotated[str, typer.Option(help="Only recordings of this rig.")] = "",
    controller: Annotated[
        str, typer.Option(help="Only controllers whose address or certificate's name starts with this text.")
    ] = "",
    since: Annotated[
        str,
        typer.Option(metavar="TIME", help="Only recordings started at or after this time, UTC: 2026-01-31[T14:30]."),
    ] = "",
    until: Annotated[str, typer.Option(metavar="TIME", help="Only recordings started before this time, UTC.")] = "",
    fit: Annotated[
        bool | None,
        typer.Option("--fit/--unfit", help="Only recordings that are (not) valid for latency measurements."),
    ] = None,
    sort: Annotated[SortKey, typer.Option(help="Sort key; largest or newest first.")] = SortKey.START,
    reverse: Annotated[bool, typer.Option("--reverse", help="Smallest or oldest first.")] = False,
    limit: Annotated[int, typer.Option(min=0, help="Maximum number of recordings to show; 0: no limit.")] = 100,
    loop: Annotated[
        bool, typer.Option("--loop/--no-loop", help="Show the loop latency (each file is read once for it).")
    ] = True,
    rebuild: Annotated[bool, typer.Option("--rebuild", help="Rebuild the index: read every file again.")] = False,
    as_json: AsJson = False,
) -> None:
    """List recordings with duration, size, loop latency, losses and ending; unusable files with the reason.

    Exit code 1: a listed recording is unusable.
    """
    from hilrig_replay.analysis.index import RunIndex
    from hilrig_runtime.config.lab import load_lab

    since_ns, until_ns = _wall_ns("--since", since), _wall_ns("--until", until)
    index = RunIndex(load_lab(config).recorder.folder if folder is None else folder)
    entries = index.load(rebuild=rebuild)
    read = len(entries)
    entries = [
        entry
        for entry in entries
        if (not rig or entry.rig == rig)
        and (not controller or any(text.startswith(controller) for text in (entry.controller, entry.certificate)))
        and (since_ns is None or entry.start_wall_ns >= since_ns)
        and (until_ns is None or entry.start_wall_ns < until_ns)
    ]
    by_loop = sort in (SortKey.P50, SortKey.P99)
    if fit is not None or by_loop:
        entries = _measured(index.measure, entries)
        entries = [entry for entry in entries if fit is None or entry.fit is fit]
    entries.sort(key=_sort_key(sort), reverse=not reverse)
    total = len(entries)
    entries = entries[: limit or None]
    if loop:
        entries = _measured(index.measure, entries)
    index.save()
    if as_json:
        _print_json(index.folder, entries, total)
    else:
        _print_table(index.folder, entries, total, read)
    if any(entry.error for entry in entries):
        raise typer.Exit(1)


def _wall_ns(option: str, text: str) -> int | None:
    from hilrig_runtime.errors import InputError

    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"{option}: expected a date or time (2026-01-31 or 2026-01-31T14:30), got {text!r}") from error
    return int(time.replace(tzinfo=time.tzinfo or UTC).timestamp() * 1e9)


def _sort_key(sort: SortKey) -> "Callable[[RunEntry], Any]":
    keys: dict[SortKey, Callable[[RunEntry], Any]] = {
        SortKey.START: lambda entry: entry.start_wall_ns,
        SortKey.RIG: lambda entry: (entry.rig, entry.start_wall_ns),
        SortKey.DURATION: lambda entry: entry.duration_s,
        SortKey.SIZE: lambda entry: entry.size,
        SortKey.P50: lambda entry: entry.loop_p50_ms or 0.0,
        SortKey.P99: lambda entry: entry.loop_p99_ms or 0.0,
        SortKey.LOST: _lost,
    }
    return keys[sort]


def _measured(
    measure: "Callable[[list[RunEntry], Callable[[int], None] | None], list[RunEntry]]", entries: "list[RunEntry]"
) -> "list[RunEntry]":
    waiting = sum(1 for entry in entries if not entry.measured)
    if waiting < 5 or not sys.stderr.isatty():
        return measure(entries, None)
    from rich.progress import Progress

    from hilrig_cli.terminal import TerminalConsole

    with Progress(console=TerminalConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("reading recordings", total=len(entries))
        return measure(entries, lambda done: progress.update(task, completed=done))


def _print_json(folder: Path, entries: "list[RunEntry]", total: int) -> None:
    from dataclasses import asdict

    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import ListedRun, RunsOutput

    runs = []
    for entry in entries:
        values = asdict(entry)
        del values["mtime_ns"], values["measured"], values["segment"], values["span"]
        values["segments"] = [str(folder / path) for path in entry.paths]
        values["path"] = str(folder / entry.path)
        values["start"] = _date(entry.start_wall_ns, "%Y-%m-%dT%H:%M:%SZ")
        runs.append(ListedRun.model_validate(values))
    print_json(RunsOutput(folder=str(folder), total=total, runs=runs))


def _date(wall_ns: int, form: str) -> str:
    return datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC).strftime(form) if wall_ns else ""


def _print_table(folder: Path, entries: "list[RunEntry]", total: int, read: int) -> None:
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    from hilrig_cli.terminal import TerminalConsole, has_fixed_width
    from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX
    from hilrig_runtime.escaping import printable

    if not entries:
        print(printable(f"no matching recordings in {folder}" if read else f"no recordings in {folder}"))
        return
    console = TerminalConsole(width=None if has_fixed_width() else FILE_WIDTH)
    wide = console.width >= WIDE_TERMINAL_COLUMNS
    title, padding = f"Recordings in {folder}", (0, 2 if wide else 1, 0, 0)
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=padding)
    names = [Path(entry.path).name.removesuffix(MCAP_SUFFIX) for entry in entries]
    # At least the name that the recorder gives to the file of a rig with a short name.
    room = console.width - 130 if wide else console.width // 3
    width = min(max(map(cell_len, names)), max(26, room))
    table.add_column("recording", width=width, overflow="fold")
    if wide:
        table.add_column("rig", no_wrap=True)
        table.add_column("start (UTC)", no_wrap=True)
    # A narrow terminal has no room for the age; losses are in the last column.
    for column in ("duration", "size", "p50 ms", "p99 ms", *(["age p99", "lost"] if wide else [])):
        table.add_column(column, justify="right", no_wrap=True)
    if wide:
        table.add_column("controller", no_wrap=True)
        table.add_column("verified", no_wrap=True)
    table.add_column("valid", no_wrap=True)
    table.add_column("ending", min_width=10, overflow="fold")
    for name, entry in zip(names, entries, strict=True):
        lost = _lost(entry)
        start = _date(entry.start_wall_ns, "%Y-%m-%d %H:%M:%S")
        table.add_row(
            name,
            *([entry.rig, start] if wide else []),
            _duration(entry.duration_s),
            format_size(entry.size),
            _number(entry.loop_p50_ms),
            _number(entry.loop_p99_ms),
            *([Text(_number(entry.age_p99_ms)), Text(str(lost), style="red" if lost else "")] if wide else []),
            *([entry.certificate or entry.controller, _yes_no(entry.verified)] if wide else []),
            _yes_no(entry.fit),
            _ending(entry) if wide or not lost else _ending(entry).append(f"; lost: {lost}", style="red"),
        )
    console.print(table)
    if total > len(entries):
        TerminalConsole(stderr=True).print(f"{total - len(entries)} more; --limit 0 shows all")


def _lost(entry: "RunEntry") -> int:
    return entry.lost_transport + entry.lost_recorder + entry.lost_file


def _ending(entry: "RunEntry") -> "Text":
    from rich.text import Text

    if entry.error:
        return Text(entry.error, style="red")
    if entry.ended in ABNORMAL_ENDINGS:
        ending = Text(f"{entry.ended}: {entry.reason}", style="yellow")
    else:
        ending = Text(entry.ended)
    if entry.overlaps:
        ending.append(f"; overlaps with {', '.join(entry.overlaps)}")
    return ending


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _yes_no(value: bool | None) -> str:
    return {None: "", True: "yes", False: "no"}[value]
