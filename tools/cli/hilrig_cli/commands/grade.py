"""`hilrig grade`: grades of a class for one assignment."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def grade(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder with the recordings of the class.", show_default=False)
    ],
    assignment: Annotated[
        Path, typer.Option("--assignment", "-a", metavar="FOLDER", help="Folder of the assignment.", show_default=False)
    ],
    roster: Annotated[
        Path, typer.Option("--roster", "-r", metavar="ROSTER.CSV", help="Roster: columns id, name, group, rig.")
    ] = Path("roster.csv"),
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder of the results.")] = Path("grades"),
    student: Annotated[
        str, typer.Option("--student", metavar="ID", help="Grade this student only; the others keep their grades.")
    ] = "",
    fill: Annotated[
        list[Path] | None,
        typer.Option("--fill", metavar="EXPORT.CSV", help="Fill this gradebook export of Moodle or Canvas."),
    ] = None,
    names: Annotated[bool, typer.Option("--names", help="Add the names to the file names of the pages.")] = False,
    pages: Annotated[bool, typer.Option("--pages/--no-pages", help="Write a page for each student.")] = True,
    as_json: AsJson = False,
) -> None:
    """Grade the recordings of a class: grades.csv, grades.json, a class page, and a page for each student.

    A recording belongs to the student whose id is its file name, the beginning of it or the name of its folder, else to
    the student of its rig. Points that a teacher writes into overrides.csv in the output folder (id, points, reason)
    are kept when grades are made again. Exit code 1: a recording has no student or can't be graded.
    """
    from rich.progress import Progress

    from hilrig_classroom.assignment import load_assignment
    from hilrig_classroom.output import GradeFolder
    from hilrig_cli.json_output.classroom import GradeOutput, GradesDocument
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_runtime.config.roster import read_roster
    from hilrig_runtime.errors import list_names
    from hilrig_runtime.escaping import printable

    task, people = load_assignment(assignment), read_roster(roster)
    target = GradeFolder(out, folder, task, people, names=names)
    console = TerminalConsole(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("grading", total=1.0)
        share = 0.5 if pages else 1.0
        document = target.grade(student, lambda done: progress.update(bar, completed=share * done))
        exports = [target.fill(path, document) for path in fill or ()]
        if pages:
            target.write_pages(document, student, lambda done: progress.update(bar, completed=share + share * done))
    problems = target.problems(document)
    if as_json:
        filled = [str(path) for path, _ in exports]
        print_json(GradeOutput(folder=str(out), grades=GradesDocument.model_validate(document), exports=filled))
    else:
        graded = sum(row["points"] is not None for row in document["students"])
        print(f"{printable(str(out))}: {graded} of {len(document['students'])} students with a grade")
        for path, export in exports:
            print(f"{printable(str(path))}: {export.filled} grades for {export.system}")
    for path, export in exports:
        # A course may have more students than the roster.
        for listed, text in ((export.unknown, "not in the roster, rows unchanged"), (export.absent, "without a row")):
            if listed:
                students = f"{len(listed)} student{'s' * (len(listed) > 1)} {text}: {list_names(listed, 40)}"
                print(printable(f"{path}: {students}"), file=sys.stderr)
    for problem in problems:
        print(printable(problem), file=sys.stderr)
    if problems:
        raise typer.Exit(1)
