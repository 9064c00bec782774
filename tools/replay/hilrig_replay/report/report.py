"""Report of one run or a group of runs as a self-contained HTML file: it needs no network and no other files."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, Final

from hilrig_replay.analysis.diagnosis.evidence import sections
from hilrig_replay.analysis.distribution import STATISTICS_TITLES
from hilrig_replay.analysis.intervals import cells
from hilrig_replay.analysis.similarity import find_similar
from hilrig_replay.analysis.summary import RunSummary, summarize
from hilrig_replay.analysis.verify import Verification, verify
from hilrig_replay.geometry.scene import parameters_of
from hilrig_replay.grading.overlap import overlapping
from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.isolation import isolated
from hilrig_replay.io.paths import display_names
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.io.segments import RunFiles, as_files
from hilrig_replay.plots.distribution_plot import distribution_figure
from hilrig_replay.plots.latency_plot import latency_figure
from hilrig_replay.plots.motion_plot import motion_figure
from hilrig_replay.plots.palette import EFFORT_SYMBOLS, event_title
from hilrig_replay.report import assets
from hilrig_replay.report.html_figures import html_figure
from hilrig_replay.report.timeline import MAX_ROWS, timeline
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import HilrigError, InputError, OperationError
from hilrig_runtime.escaping import as_html
from hilrig_runtime.process.process_pool import process_pool

_MIN_RUNS_FOR_PROCESSES: Final = 4
"""Fewer runs take less time than the start of worker processes."""

_MAX_ROWS_OF_GROUP: Final = 120_000
"""States of all runs of a page, about 15 MB."""


@dataclass(frozen=True, slots=True)
class _Page:
    summary: RunSummary
    motion: str
    """Still picture of the motion, for paper."""
    latency: str
    """Picture of the latency; empty: no samples."""
    timeline: dict[str, Any]
    verified: Verification | None


@dataclass(frozen=True, slots=True)
class Report:
    """A report page and its content."""

    html: str
    runs: tuple[dict[str, Any], ...]
    """JSON-compatible values of each run, in ranking order."""
    left_out: tuple[str, ...]
    """Reason why a recording is not in the report, one sentence per recording."""
    same_torques: tuple[str, ...]
    """Pairs of runs with the same torques, one sentence per pair."""
    overlaps: tuple[str, ...]
    """Manual recordings of other runs, which are not graded; one sentence per recording."""


def build_report(
    runs: Sequence[Path | RunFiles],
    *,
    verified: bool = False,
    task: TaskConfig | None = None,
    on_progress: Callable[[float], None] | None = None,
    workers: int | None = 1,
    title: str = "",
    introduction: str = "",
) -> Report:
    """Build the report of one run, or of several with a ranking; unreadable recordings are listed in the report.

    Args:
        runs: recordings, each of one file or several segments.
        verified: re-simulate each run and report whether the result is identical.
        task: grading task for all runs; None: the task in each recording's lab.toml.
        on_progress: called with the completed share of the runs, 0 to 1.
        workers: number of processes; None: one per core if there are enough runs.
        title: title of the page; empty: session or number of runs.
        introduction: HTML below the title.

    Raises:
        InputError: the only recording, or every recording, is damaged or has an unsupported content.
    """
    pages: list[_Page] = []
    left_out: list[str] = []
    for done, one in enumerate(_pages(runs, verified, task, workers), start=1):
        if isinstance(one, _Page):
            pages.append(one)
        elif len(runs) == 1:
            raise one
        else:
            left_out.append(str(one))
        if on_progress is not None:
            on_progress(done / len(runs))
    if not pages:
        raise InputError("no readable recording:\n" + "\n".join(left_out))
    pages = sorted(_marked(pages), key=_rank)
    verdicts = [{} if page.verified is None else {"verify": page.verified.as_dict()} for page in pages]
    values = tuple({**page.summary.as_dict(), **verdict} for page, verdict in zip(pages, verdicts, strict=True))
    pairs = _same_torques(pages)
    overlaps = tuple(
        f"{page.summary.name}: recorded manually at the time of {', '.join(page.summary.overlaps)}: not graded"
        for page in pages
        if _is_second_recording(page)
    )
    return Report(
        _html(pages, left_out, pairs, overlaps, title, introduction), values, tuple(left_out), pairs, overlaps
    )


def _marked(pages: Sequence[_Page]) -> list[_Page]:
    """The pages with the sessions that overlap; a manual recording of a controller's session is not graded."""
    marked = []
    for page, sessions in zip(pages, overlapping([page.summary.span for page in pages]), strict=True):
        summary = replace(page.summary, overlaps=sessions)
        if sessions and summary.span.is_manual:
            summary = replace(summary, grade=None, placement=None)
        marked.append(replace(page, summary=summary))
    return marked


def _is_second_recording(page: _Page) -> bool:
    return bool(page.summary.overlaps) and page.summary.span.is_manual


def _same_torques(pages: Sequence[_Page]) -> tuple[str, ...]:
    runs = [page.summary for page in pages]
    return tuple(
        f"{runs[one].name} and {runs[other].name}: "
        + (
            "the same recording"
            if runs[one].session == runs[other].session
            else f"{int(100 * share)} % of the torques written by the controllers are identical"
        )
        for one, other, share in find_similar([run.torques for run in runs])
    )


def _html(
    pages: Sequence[_Page],
    left_out: Sequence[str],
    pairs: Sequence[str],
    overlaps: Sequence[str],
    title: str,
    introduction: str,
) -> str:
    if len(pages) == 1 and not left_out:
        summary = pages[0].summary
        title = title or f"Run {summary.session}"
        body = (
            f'<h1>{as_html(title)}</h1><p class="quiet">{as_html(_origin(summary))}</p>{introduction}'
            f"{_run(1, pages[0])}"
        )
    else:
        title = title or f"{len(pages)} run{'s' * (len(pages) > 1)}"
        details = "".join(
            f"<details><summary>{number}. {as_html(page.summary.name)} "
            f'<span class="quiet">· {as_html(_session_and_origin(page.summary))}</span></summary>'
            f"{_run(number, page)}</details>"
            for number, page in enumerate(pages, start=1)
        )
        notes = (
            _list_section("Skipped recordings", left_out)
            + _list_section("Runs with the same torques", pairs)
            + _list_section("Second recordings of a session", overlaps)
        )
        body = f"<h1>{as_html(title)}</h1>{introduction}{_overview(pages)}{notes}{details}"
    scripts = "".join(f"<script>{script}</script>" for script in assets.scripts())
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{assets.content_policy()}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{as_html(title)}</title><style>{assets.style()}</style></head><body>{body}"
        f"<!-- {assets.license_text()} -->{scripts}</body></html>\n"
    )


def _pages(
    runs: Sequence[Path | RunFiles], verified: bool, task: TaskConfig | None, workers: int | None
) -> Iterator[_Page | HilrigError]:
    """Page of each run, or the reason why it is missing, in the order of `runs`."""
    files = list(map(as_files, runs))
    paths = [run[0] for run in files]
    names = display_names(paths)
    rows = min(MAX_ROWS, _MAX_ROWS_OF_GROUP // len(paths))
    tasks = files, [names[path] for path in paths], repeat(verified), repeat(task), repeat(rows)
    if workers == 1 or len(paths) < _MIN_RUNS_FOR_PROCESSES:
        yield from map(_page_or_error, *tasks)
    else:
        with process_pool(len(paths), workers) as executor:
            yield from executor.map(_page_or_error, *tasks)


def _page_or_error(
    files: RunFiles, name: str, verified: bool, task: TaskConfig | None, max_rows: int
) -> _Page | HilrigError:
    try:
        with isolated(files[0]):
            return _page(open_run(files), name, verified, task, max_rows)
    except HilrigError as error:
        # The exceptions of recordings can't be sent between processes.
        return OperationError(str(error)) if isinstance(error, OperationError) else InputError(str(error))


def _page(run: Run, name: str, verified: bool, task: TaskConfig | None, max_rows: int) -> _Page:
    summary = summarize(run, task)
    parameters = parameters_of(run.parameters_json)
    targets = task or recorded_task(run)
    motion = html_figure(
        motion_figure(summary.trajectory, parameters, targets), "joint positions, joint efforts and tool path"
    )
    latency = ""
    if summary.latency.loop_ms is not None:
        latency = html_figure(
            latency_figure(summary.latency, run), "loop latency: histogram, stages, tail distribution, course over time"
        )
    columns = timeline(run, summary.latency, parameters, targets, summary.grade, max_rows=max_rows)
    # Frees the samples once they are drawn: a group may have many runs.
    summary = replace(summary, name=name, latency=summary.latency.without_table())
    return _Page(summary, motion, latency, columns, verify(run.file.paths) if verified else None)


def _run(number: int, page: _Page) -> str:
    summary, name = page.summary, f"run-{number}"
    # "</script>" in a text would end the element.
    values = json.dumps(page.timeline, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return (
        f"<section>{_facts(page)}</section>"
        f"<section><h2>Causes and observations</h2>{_findings(summary)}</section>"
        f"{_task(summary)}"
        f'<section><h2>Motion</h2><div class="player" id="{name}"></div><div class="still">{page.motion}</div>'
        f'<script type="application/json" id="{name}-data">{values}</script>{_efforts(summary)}</section>'
        f"<section><h2>Loop latency</h2>{_latency(summary)}{page.latency}</section>"
        f"<section><h2>Events</h2>{_events(name, page)}</section>"
    )


def _origin(summary: RunSummary) -> str:
    # A session that was started by a controller has the controller's address.
    name = f"{summary.certificate} at " if summary.certificate else ""
    started_by = f"controlled by {name}{summary.controller}" if summary.controller else "recorded manually"
    return f"{summary.rig}{' of ' + summary.lab if summary.lab else ''} · {started_by} · {summary.start}"


def _session_and_origin(summary: RunSummary) -> str:
    # For a renamed file, also the session under which it was recorded.
    session = "" if summary.name == summary.session else f"{summary.session} · "
    overlaps = f" · overlaps with {', '.join(summary.overlaps)}" if summary.overlaps else ""
    return session + _origin(summary) + overlaps


def _facts(page: _Page) -> str:
    summary = page.summary
    # Without the name of the setting.
    ended = summary.ended.partition(" (")[0]
    facts = [(f"{summary.duration_s:.1f} s", f"duration; {ended or 'unknown ending'}")]
    if summary.grade is not None:
        facts.append((f"{summary.grade.percent} %", f"task: {summary.grade.headline()}"))
    if summary.placement is not None and (summary.grade is None or summary.grade.parts):
        error = summary.placement.largest_error_mm
        within = "none placed" if error is None else f"largest error {error:.1f} mm"
        facts.append((f"{summary.placement.placed} of {len(summary.placement.parts)}", f"parts placed; {within}"))
    loop, qualifier = summary.latency.loop_ms, summary.latency.qualifier
    if loop is None:
        facts.append(("–", f"loop latency: {summary.latency.reasons[-1].text}"))
    else:
        facts.append((f"{loop.p50:.1f} ms", f"loop latency p50{qualifier}; p99 {loop.p99:.1f} ms"))
    if (age := summary.latency.age_ms) is not None:
        facts.append((f"{age.p50:.1f} ms", f"age of the acting torque p50{qualifier}; p99 {age.p99:.1f} ms"))
    facts.append((f"{summary.motion.tool_path_m:.2f} m", f"tool path; top speed {summary.motion.top_speed:.2f} m/s"))
    facts.append((f"{summary.motion.work_j:.1f} J", "drive work"))
    if page.verified is not None:
        facts.append(("verified" if page.verified.same else "not reproduced", page.verified.sentence()))
    cells = "".join(f"<div><b>{as_html(value)}</b><span>{as_html(text)}</span></div>" for value, text in facts)
    return f'<div class="facts">{cells}</div>'


def _task(summary: RunSummary) -> str:
    grade = summary.grade
    if grade is None:
        return ""
    rows = "".join(
        f'<tr><td>{as_html(goal)}</td><td class="{"good" if reached else "bad"}">{"yes" if reached else "no"}</td>'
        f'<td class="text">{as_html(text)}</td></tr>'
        for goal, reached, text in grade.lines()
    )
    head = "<thead><tr><th>goal</th><th>reached</th><th>result</th></tr></thead>"
    title = f"Task: {as_html(grade.title)}" if grade.title else "Task"
    verdict = f'<p class="{"good" if grade.passed else "bad"}">{as_html(grade.headline())}.</p>'
    return (
        f"<section><h2>{title}</h2>{verdict}"
        f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div></section>'
    )


def _efforts(summary: RunSummary) -> str:
    motion = summary.motion
    rows = [
        ["peak, N·m (τ3: N)", *(f"{value:.2f}" for value in motion.peak_effort)],
        ["share of time at register limit", *(f"{share:.1%}" for share in motion.saturated_share)],
    ]
    return _table(["effort", *EFFORT_SYMBOLS], rows)


def _latency(summary: RunSummary) -> str:
    latency = summary.latency
    rows = []
    if latency.loop_ms is not None:
        known = latency.intervals_ms
        rows.append([f"loop{latency.qualifier}", *cells(latency.loop_ms, known["loop"])])
        rows += [[stage.title, *cells(latency.stages_ms[stage.key], known[stage.key])] for stage in latency.stages]
    if latency.age_ms is not None:
        rows.append([f"age{latency.qualifier}", *cells(latency.age_ms, latency.intervals_ms["age"])])
    rows.append(["tick lateness", *cells(latency.jitter_ms.tick_lateness, latency.intervals_ms["tick_lateness"])])
    verdict = (
        '<p class="good">Valid for latency measurements.</p>'
        if latency.fit
        else f'<p class="bad">Not valid for latency measurements: {as_html(latency.reason_text())}.</p>'
    )
    notes = "".join(f'<p class="quiet">{as_html(note)}</p>' for note in latency.notes())
    return f"{_table(['ms', *STATISTICS_TITLES], rows)}{notes}{verdict}"


def _findings(summary: RunSummary) -> str:
    return "".join(
        f"<p>{title}:</p><ul>{''.join(f'<li>{as_html(sentence)}</li>' for sentence in sentences)}</ul>"
        for title, sentences in sections(summary.latency.findings)
    )


def _events(name: str, page: _Page) -> str:
    events, others = page.timeline["events"], page.timeline["other_events"]
    if not events:
        return "<p>No events.</p>"
    counts = ", ".join(
        f"{event_title(kind)} {sum(by_severity.values())}" for kind, by_severity in page.summary.events.items()
    )
    rows = "".join(
        f'<tr data-run="{name}">'
        f'<td><button type="button" data-time="{event["time"]}">{event["time"]:.2f} s</button></td>'
        f"<td>{as_html(event['title'])}</td><td>{as_html(event['severity'])}</td>"
        f'<td class="text">{as_html(event["text"])}</td></tr>'
        for event in events
    )
    more = f'<p class="quiet">{others} later events are not listed.</p>' if others else ""
    head = "<thead><tr><th>time</th><th>event</th><th>severity</th><th>text</th></tr></thead>"
    return (
        f'<p class="quiet">{as_html(counts)}</p>'
        f'<div class="events"><table>{head}<tbody>{rows}</tbody></table></div>{more}'
    )


def _overview(pages: Sequence[_Page]) -> str:
    graded = any(page.summary.grade is not None for page in pages)
    header = ["run", *(("goals", "time, s", "error, mm") if graded else ("parts placed", "placement error, mm"))]
    header += ["loop p50 / p99, ms", "age p99, ms", "path, m", "work, J", "saturation", "alarms", "latency valid"]
    rows = []
    for number, page in enumerate(pages, start=1):
        summary, loop, age = page.summary, page.summary.latency.loop_ms, page.summary.latency.age_ms
        rows.append(
            [
                f"{number}. {summary.name}",
                *(_grade_cells(summary) if graded else _placement_cells(summary)),
                "–" if loop is None else f"{loop.p50:.1f} / {loop.p99:.1f}",
                _or_dash(None if age is None else age.p99, 1),
                f"{summary.motion.tool_path_m:.2f}",
                f"{summary.motion.work_j:.1f}",
                f"{max(summary.motion.saturated_share):.1%}",
                str(summary.alarms),
                "yes" if summary.latency.fit else "no",
            ]
        )
    by = "goals reached, then by completion time, then by error" if graded else "parts placed, then by placement error"
    note = f'<p class="quiet">Ranked by {by}, then by tool path length.</p>'
    figure = html_figure(
        distribution_figure([page.summary for page in pages]),
        "ranked runs: goals or parts, time or error, drive work, loop latency",
    )
    return f"<section>{_ranking(header, rows)}{note}{figure}</section>"


def _list_section(title: str, sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{as_html(sentence)}</li>" for sentence in sentences)
    return f'<section><h2>{title}</h2><ul class="bad">{items}</ul></section>' if items else ""


def _grade_cells(summary: RunSummary) -> list[str]:
    grade = summary.grade
    if grade is None:
        return ["–"] * 3
    return [f"{grade.percent} %", _or_dash(grade.done_s, 1), _or_dash(grade.error_mm)]


def _placement_cells(summary: RunSummary) -> list[str]:
    task = summary.placement
    return ["–"] * 2 if task is None else [f"{task.placed} of {len(task.parts)}", _or_dash(task.largest_error_mm)]


def _or_dash(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _rank(page: _Page) -> tuple[float, ...]:
    task, grade = page.summary.placement, page.summary.grade
    if _is_second_recording(page):
        return (2.0,)
    # Without a controller the tool path is the shortest, so that such a run comes last among equals.
    path_m = page.summary.motion.tool_path_m if page.summary.latency.samples else float("inf")
    if grade is not None:
        return (0.0, *grade.rank, path_m)
    # Runs without a task come after graded runs.
    if task is None:
        return (1.0, 0.0, 0.0, 0.0, path_m)
    error = task.largest_error_mm
    return (1.0, -task.placed, 0.0, float("inf") if error is None else error, path_m)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{as_html(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{as_html(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _ranking(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table whose rows become cards on a narrow page; each cell has its column's name for that."""
    head = "".join(f"<th>{as_html(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td data-label="{as_html(column)}">{as_html(cell)}</td>' for column, cell in zip(header, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll ranking"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
