"""`hilrig assign check FOLDER`: validates an assignment of a class, also with a reference solution."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, log

if TYPE_CHECKING:
    from collections.abc import Callable

    from hilrig_classroom.assignment import Assignment
    from hilrig_classroom.evaluation import Attempt
    from hilrig_runtime.config.lab import LabConfig

app = typer.Typer(help="Prepare the assignments of a class.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass


@app.command()
def check(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the assignment.", show_default=False)],
    solution: Annotated[
        Path | None,
        typer.Option(
            metavar="PROGRAM", help="Run a lab with this program as the controller, and grade it. Takes --host, --port."
        ),
    ] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(min=1.0, help="Longest time of the program, s; default: 10 s more than the task's, or 60."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FOLDER", help="Keep the solution's recording there.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Validate an assignment: settings, lab file, task, hand-out and starter program; all mistakes are named.

    With --solution, a lab of the assignment's lab file runs on free ports with the program as its controller, and the
    recording is graded. Exit code 1: the solution misses a goal.
    """
    from datetime import UTC, datetime

    from rich.progress import Progress

    from hilrig_classroom.check import check_assignment, warnings
    from hilrig_cli.json_output.classroom import AssignCheckOutput, AttemptValues
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_runtime.escaping import printable

    assignment, lab = check_assignment(folder)
    config, task = assignment.config, assignment.task
    notes = warnings(assignment, datetime.now(UTC))
    for note in notes:
        print(f"warning: {note}", file=sys.stderr)
    attempt = None
    if solution is not None:
        limit_s = time_limit or (task.time_limit_s + 10.0 if task.time_limit_s else 60.0)
        console = TerminalConsole(stderr=True)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            bar = progress.add_task(solution.name, total=1.0)
            show = partial(progress.update, bar)
            attempt = _graded(assignment, lab, solution, out, limit_s, lambda share: show(completed=share))
    if as_json:
        solved = None if attempt is None else AttemptValues.model_validate(attempt.as_dict())
        points = config.rubric.points
        print_json(AssignCheckOutput(assignment=config.title, points=points, warnings=list(notes), solution=solved))
    else:
        print(f"{printable(str(folder))}: {printable(config.title)}: valid")
        if attempt is not None:
            _print_attempt(attempt, config.rubric.points)
    if attempt is not None and attempt.score < 1.0:
        raise typer.Exit(1)


def _graded(
    assignment: "Assignment",
    lab: "LabConfig",
    solution: Path,
    out: Path | None,
    time_limit_s: float,
    on_progress: "Callable[[float], None]",
) -> "Attempt":
    """Run a solution and grade its recording."""
    from tempfile import TemporaryDirectory

    from hilrig_classroom.evaluation import evaluate, identify, with_points
    from hilrig_cli.local.program_run import record_program
    from hilrig_replay.io.output_file import output_file
    from hilrig_replay.io.run import open_run

    with TemporaryDirectory(prefix="hilrig-") as folder:
        recording = record_program(lab, solution, Path(folder), time_limit_s, log, on_progress)
        run = open_run((recording,))
        attempt = with_points(evaluate(identify((recording.name,), run), run, assignment.task), assignment)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            with output_file(out / recording.name) as temporary:
                temporary.write_bytes(recording.read_bytes())
    return attempt


def _print_attempt(attempt: "Attempt", points: float) -> None:
    for goal in attempt.goals:
        print(f"{'reached' if goal.reached else 'missed'}: {goal.name}: {goal.text}")
    latency = (
        f"{attempt.latency_ms:.0f} ms" if attempt.latency_ms is not None else f"not valid ({attempt.data_quality})"
    )
    print(f"age of the acting torque, 95th percentile: {latency}; work of the drives: {attempt.work_j:.0f} J")
    print(f"points: {attempt.raw:g} of {points:g}")
