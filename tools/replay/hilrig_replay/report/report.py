"""A run, or a class of runs, as one HTML file that needs nothing else: no network, no script, no other file."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import repeat
from pathlib import Path
from typing import Any, Final

from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.similarity import find_similar
from hilrig_replay.analysis.summary import RunSummary, summarize
from hilrig_replay.analysis.verify import Verification, verify
from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.paths import display_names
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.distribution_plot import distribution_figure
from hilrig_replay.plots.latency_plot import latency_figure
from hilrig_replay.plots.motion_plot import motion_figure
from hilrig_replay.plots.palette import EFFORT_SYMBOLS, STAGE_NAMES
from hilrig_replay.report.html_figures import picture
from hilrig_replay.rerun_view.scene import parameters_of
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import InputError
from hilrig_runtime.process.process_pool import all_cores

_COLUMNS: Final = ("p50", "p95", "p99", "p999", "max", "mean", "std")
_GRAVE: Final = ("WATCHDOG_TRIP", "COMMAND_LOST", "OVERRUN", "SATURATION", "LEASE_REFUSED")
"""Kinds of events that a teacher looks for."""
_WORTH_PROCESSES: Final = 4
"""Fewer runs are done sooner than processes are started for them."""

STYLE: Final = """
:root { color-scheme: light; font: 15px/1.5 system-ui, sans-serif; color: #24292f; background: #f5f6f8; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 72rem; }
h1 { font-size: 1.6rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 0 0 .6rem; }
p { margin: .3rem 0; } .quiet { color: #5d6771; }
section, details { background: #fff; border: 1px solid #dfe3e8; border-radius: 8px;
  padding: 1rem 1.2rem; margin: 1rem 0; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.5rem, 1fr)); gap: .8rem; }
.facts div { border-left: 3px solid #4c78a8; padding-left: .6rem; } .facts b { display: block; font-size: 1.25rem; }
.facts span { color: #5d6771; font-size: .85rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .45rem; text-align: right; border-bottom: 1px solid #e8ebef; white-space: nowrap; }
th:first-child, td:first-child, td.text { text-align: left; }
td.text { white-space: normal; min-width: 16rem; } thead th { color: #5d6771; font-weight: 600;
  white-space: normal; vertical-align: bottom; }
img { max-width: 100%; height: auto; display: block; }
.picture { display: flex; align-items: flex-start; } .picture img { min-width: 0; }
@media (max-width: 44rem) { .picture { display: block; }
  table { font-size: .75rem; } th, td { padding: .25rem .15rem; }
  section, details { padding: .8rem .6rem; }
  td:first-child { white-space: normal; }
  td.text { min-width: 9rem; } }
@media (max-width: 44rem) { .ranking thead { display: none; } .ranking table, .ranking tbody { display: block; }
  .ranking tr { display: grid; grid-template-columns: repeat(auto-fill, minmax(6.5rem, 1fr)); padding: .4rem 0;
    border-bottom: 1px solid #dfe3e8; }
  .ranking td { text-align: left; border: 0; white-space: normal; font-size: .85rem; }
  .ranking td:first-child { grid-column: 1 / -1; font-weight: 600; overflow-wrap: anywhere; }
  .ranking td + td::before { content: attr(data-what); display: block; color: #5d6771; font-size: .7rem; } }
@media (max-width: 30rem) { table { font-size: .68rem; } th, td { padding: .25rem .1rem; } }
li { margin: .25rem 0; overflow-wrap: anywhere; }
.good { color: #1a7f37; } .bad { color: #b35900; }
summary { cursor: pointer; font-weight: 600; } summary span { font-weight: 400; }
@media print { body { max-width: none; } section, details { break-inside: avoid; } }
"""


@dataclass(frozen=True, slots=True)
class _Page:
    summary: RunSummary
    pictures: tuple[str, ...]
    verified: Verification | None


@dataclass(frozen=True, slots=True)
class Report:
    """One page, and what stands in it."""

    html: str
    runs: tuple[dict[str, Any], ...]
    """Each run as plain values for JSON, the best first."""
    left_out: tuple[str, ...]
    """Why a recording is not in it, one sentence each."""
    alike: tuple[str, ...]
    """Which runs were driven by the same torques, one sentence a pair."""


def report(
    paths: Sequence[Path],
    *,
    verified: bool = False,
    task: TaskConfig | None = None,
    tick: Callable[[float], None] | None = None,
    workers: int | None = 1,
) -> Report:
    """The report of one run, or of several with an overview that ranks them; those that can't be read are named in it.

    Args:
        paths: recordings.
        verified: re-simulate each run too, and say whether it came out the same.
        task: what the runs are graded by; None: each by what its own lab said.
        tick: hears the share of the runs that are done.
        workers: processes; None: one a core, where there are enough runs to be worth it.

    Raises:
        InputError: there is one only, or none that can be read: it is damaged, or not understood.
    """
    pages: list[_Page] = []
    left_out: list[str] = []
    for done, one in enumerate(_pages(paths, verified, task, workers), start=1):
        if isinstance(one, _Page):
            pages.append(one)
        elif len(paths) == 1:
            raise one
        else:
            left_out.append(str(one))
        if tick is not None:
            tick(done / len(paths))
    if not pages:
        raise InputError("no run can be reported:\n" + "\n".join(left_out))
    pages.sort(key=_rank)
    verdicts = [{} if page.verified is None else {"verify": page.verified.as_dict()} for page in pages]
    plain = tuple({**page.summary.as_dict(), **verdict} for page, verdict in zip(pages, verdicts, strict=True))
    pairs = _alike(pages)
    return Report(_html(pages, left_out, pairs), plain, tuple(left_out), pairs)


def _alike(pages: Sequence[_Page]) -> tuple[str, ...]:
    runs = [page.summary for page in pages]
    return tuple(
        f"{runs[one].name} and {runs[other].name}: "
        + (
            "the same recording"
            if runs[one].session == runs[other].session
            else f"{int(100 * share)} % of the torques that the controllers wrote are the same to the last count"
        )
        for one, other, share in find_similar([run.torques for run in runs])
    )


def _html(pages: Sequence[_Page], left_out: Sequence[str], pairs: Sequence[str]) -> str:
    if len(pages) == 1 and not left_out:
        summary = pages[0].summary
        title = f"Run {summary.session}"
        body = f'<h1>{escape(title)}</h1><p class="quiet">{escape(_who(summary))}</p>{_run(pages[0])}'
    else:
        title = f"{len(pages)} run{'s' * (len(pages) > 1)}"
        details = "".join(
            f"<details><summary>{number}. {escape(page.summary.name)} "
            f'<span class="quiet">· {escape(_whose(page.summary))}</span></summary>{_run(page)}</details>'
            for number, page in enumerate(pages, start=1)
        )
        told = _named("Left out", left_out) + _named("The same torques", pairs)
        body = f"<h1>{title}</h1>{_overview(pages)}{told}{details}"
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )


def _pages(
    paths: Sequence[Path], verified: bool, task: TaskConfig | None, workers: int | None
) -> Iterator[_Page | InputError]:
    """Each run's page, or why there is none, in the order of `paths`."""
    names = display_names(paths)
    tasks = paths, [names[path] for path in paths], repeat(verified), repeat(task)
    if workers == 1 or len(paths) < _WORTH_PROCESSES:
        yield from map(_page_or_reason, *tasks)
    else:
        with all_cores(len(paths), workers) as executor:
            yield from executor.map(_page_or_reason, *tasks)


def _page_or_reason(path: Path, name: str, verified: bool, task: TaskConfig | None) -> _Page | InputError:
    try:
        return _page(open_run(path), name, verified, task)
    except InputError as error:
        return error


def _page(run: Run, name: str, verified: bool, task: TaskConfig | None) -> _Page:
    summary = summarize(run, task)
    parameters = parameters_of(run.parameters_json)
    targets = task or recorded_task(run)
    pictures = [
        picture(motion_figure(summary.trajectory, parameters, targets), "positions, efforts and the tool's way")
    ]
    if summary.latency.loop_ms is not None:
        pictures.append(picture(latency_figure(summary.latency, run), "loop latency: histogram, stages, tail, course"))
    # A class has many runs: the samples of each are let go once they are drawn.
    summary = replace(summary, name=name, latency=summary.latency.without_table())
    return _Page(summary, tuple(pictures), verify(run.path) if verified else None)


def _run(page: _Page) -> str:
    summary = page.summary
    return (
        f"<section>{_facts(page)}</section>"
        f"{_task(summary)}"
        f"<section><h2>Motion</h2>{page.pictures[0]}{_efforts(summary)}</section>"
        f"<section><h2>Loop latency</h2>{_latency(summary)}{''.join(page.pictures[1:])}</section>"
        f"<section><h2>Events</h2>{_events(summary)}</section>"
    )


def _who(summary: RunSummary) -> str:
    # A session that a controller began has its address.
    who = f"controlled by {summary.controller}" if summary.controller else "recorded by hand"
    return f"{summary.rig}{' of ' + summary.lab if summary.lab else ''} · {who} · {summary.start}"


def _whose(summary: RunSummary) -> str:
    # A file that was renamed says in its text what it was recorded as.
    renamed = "" if summary.name == summary.session else f"{summary.session} · "
    return renamed + _who(summary)


def _facts(page: _Page) -> str:
    summary = page.summary
    facts = [(f"{summary.duration_s:.1f} s", f"length; {summary.ended or 'how it ended is not said'}")]
    if summary.grade is not None:
        facts.append((f"{summary.grade.percent} %", f"of the task: {summary.grade.headline()}"))
    if summary.placement is not None:
        placement = summary.placement
        error = placement.largest_error_mm
        within = "none placed" if error is None else f"within {error:.1f} mm"
        facts.append((f"{placement.placed} of {len(placement.parts)}", f"parts in their places, {within}"))
    loop = summary.latency.loop_ms
    if loop is None:
        facts.append(("–", f"loop latency: {summary.latency.reasons[-1]}"))
    else:
        facts.append((f"{loop.p50:.1f} ms", f"loop latency p50; p99 {loop.p99:.1f} ms"))
    facts.append(
        (f"{summary.motion.tool_path_m:.2f} m", f"way of the tool, at most {summary.motion.top_speed:.2f} m/s")
    )
    facts.append((f"{summary.motion.work_j:.1f} J", "work of the drives"))
    if page.verified is not None:
        facts.append(("verified" if page.verified.same else "diverges", page.verified.sentence()))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in facts)
    return f'<div class="facts">{cells}</div>'


def _task(summary: RunSummary) -> str:
    grade = summary.grade
    if grade is None:
        return ""
    rows = "".join(
        f'<tr><td>{escape(goal)}</td><td class="{"good" if reached else "bad"}">{"yes" if reached else "no"}</td>'
        f'<td class="text">{escape(said)}</td></tr>'
        for goal, reached, said in grade.lines()
    )
    head = "<thead><tr><th>goal</th><th>reached</th><th></th></tr></thead>"
    title = f"Task: {escape(grade.title)}" if grade.title else "Task"
    verdict = f'<p class="{"good" if grade.passed else "bad"}">{escape(grade.headline())}.</p>'
    return (
        f"<section><h2>{title}</h2>{verdict}"
        f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div></section>'
    )


def _efforts(summary: RunSummary) -> str:
    motion = summary.motion
    rows = [
        ["largest, N·m (τ3: N)", *(f"{value:.2f}" for value in motion.peak_effort)],
        ["at the register's limit", *(f"{share:.1%}" for share in motion.saturated_share)],
    ]
    return _table(["effort", *EFFORT_SYMBOLS], rows)


def _latency(summary: RunSummary) -> str:
    latency = summary.latency
    rows = [] if latency.loop_ms is None else [["loop", *_figures(latency.loop_ms)]]
    rows += [[STAGE_NAMES[stage], *_figures(statistics)] for stage, statistics in latency.stages_ms.items()]
    rows.append(["tick lateness", *_figures(latency.jitter_ms.tick_lateness)])
    fitness = (
        '<p class="good">Fit for latency claims.</p>'
        if latency.fit
        else f'<p class="bad">Not fit for latency claims: {escape("; ".join(latency.reasons))}.</p>'
    )
    found = "".join(f"<li>{escape(finding.text)}</li>" for finding in latency.findings)
    table = _table(["ms", *(column.replace("p999", "p99.9") for column in _COLUMNS)], rows)
    return f"{table}{fitness}{f'<ul>{found}</ul>' if found else ''}"


def _events(summary: RunSummary) -> str:
    if not summary.events:
        return "<p>Nothing happened.</p>"
    rows = [[kind.replace("_", " ").lower(), str(count)] for kind, count in summary.events.items()]
    return _table(["event", "times"], rows)


def _overview(pages: Sequence[_Page]) -> str:
    graded = any(page.summary.grade is not None for page in pages)
    header = ["run", *(("goals", "done, s", "error, mm") if graded else ("parts placed", "placing error, mm"))]
    header += ["loop p50 / p99, ms", "way, m", "work, J", "saturated", "alarms", "fit"]
    rows = []
    for number, page in enumerate(pages, start=1):
        summary, loop = page.summary, page.summary.latency.loop_ms
        rows.append(
            [
                f"{number}. {summary.name}",
                *(_graded(summary) if graded else _placed(summary)),
                "–" if loop is None else f"{loop.p50:.1f} / {loop.p99:.1f}",
                f"{summary.motion.tool_path_m:.2f}",
                f"{summary.motion.work_j:.1f}",
                f"{max(summary.motion.saturated_share):.1%}",
                str(sum(summary.events.get(kind, 0) for kind in _GRAVE)),
                "yes" if summary.latency.fit else "no",
            ]
        )
    by = "share of the goals, then by time, then by error" if graded else "parts placed, then by placing error"
    note = f'<p class="quiet">Ranked by {by}, then by the way of the tool.</p>'
    distributions = picture(distribution_figure([page.summary for page in pages]), "how the runs are distributed")
    return f"<section>{_ranking(header, rows)}{note}{distributions}</section>"


def _named(title: str, sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f'<section><h2>{title}</h2><ul class="bad">{items}</ul></section>' if items else ""


def _graded(summary: RunSummary) -> list[str]:
    grade = summary.grade
    if grade is None:
        return ["–"] * 3
    return [f"{grade.percent} %", _or_dash(grade.done_s, 1), _or_dash(grade.error_mm)]


def _placed(summary: RunSummary) -> list[str]:
    task = summary.placement
    return ["–"] * 2 if task is None else [f"{task.placed} of {len(task.parts)}", _or_dash(task.largest_error_mm)]


def _or_dash(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _rank(page: _Page) -> tuple[float, ...]:
    task, grade = page.summary.placement, page.summary.grade
    # A tool that nobody moved went the shortest way: among equals such a run comes last.
    way = page.summary.motion.tool_path_m if page.summary.latency.samples else float("inf")
    if grade is not None:
        return (0.0, *grade.rank, way)
    # Beside graded runs, those without a task come last.
    if task is None:
        return (1.0, 0.0, 0.0, 0.0, way)
    error = task.largest_error_mm
    return (1.0, -task.placed, 0.0, float("inf") if error is None else error, way)


def _figures(statistics: Statistics) -> list[str]:
    return [f"{getattr(statistics, column):.3f}" for column in _COLUMNS]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _ranking(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose rows are cards on a narrow page: each cell knows what it is."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td data-what="{escape(what, quote=True)}">{escape(cell)}</td>'
            for what, cell in zip(header, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll ranking"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
