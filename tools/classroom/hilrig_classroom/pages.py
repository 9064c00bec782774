"""Pages of a graded assignment: one for the class, one for each student with the report of the run that counts."""

from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

from hilrig_classroom.assignment import Assignment
from hilrig_classroom.gradebook import feedback, used_attempt
from hilrig_replay.io.segments import RunFiles
from hilrig_replay.report import assets
from hilrig_replay.report.report import build_report
from hilrig_runtime.config.roster import Roster, Student
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import HilrigError
from hilrig_runtime.escaping import as_html
from hilrig_runtime.process.process_pool import process_pool


def class_page(document: Mapping[str, Any], roster: Roster, page_names: Mapping[str, str]) -> str:
    """Overview of a class: one row a student, runs to be compared, and recordings without a student.

    Args:
        document: content of `grades.json`.
        roster: the class.
        page_names: file name of each student's page by id, relative to this page.
    """
    by_id = {row["id"]: row for row in document["students"]}
    rows = "".join(
        _class_row(student, by_id[student.id], page_names.get(student.id, ""))
        for student in roster.students
        if student.id in by_id
    )
    graded = [row["points"] for row in by_id.values() if row["points"] is not None]
    mean = f"mean {sum(graded) / len(graded):.2f} of {document['points']:g} points" if graded else "no grades"
    notes = _section(
        "Runs to compare",
        similar_groups(document),
        "Similar runs are worth a look. No conclusion is drawn, and no points change.",
    )
    notes += _section(
        "Recordings without a student", [f"{each['file']}: {each['reason']}" for each in document["unassigned"]], ""
    )
    columns = ("student", "group", "points", "goals", "attempts", "note")
    head = "".join(f"<th>{column}</th>" for column in columns)
    body = (
        f"<h1>{as_html(document['assignment'])}</h1>"
        f'<p class="quiet">{len(graded)} of {len(by_id)} students with a grade; {mean}</p>'
        f'<section><div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
        f"</section>{notes}"
    )
    return _page(str(document["assignment"]), body)


def similar_groups(document: Mapping[str, Any]) -> list[str]:
    """One sentence for each group of students with similar runs: their files, and the range of the similarity."""
    group_of: dict[str, set[str]] = {}
    for row in document["students"]:
        members = {row["id"], *(run["student"] for run in row["similar"])}
        group = members.union(*(group_of.get(member, set()) for member in members))
        group_of.update(dict.fromkeys(group, group))
    sentences = []
    for group in {id(group): group for group in group_of.values() if len(group) > 1}.values():
        runs = [run for row in document["students"] if row["id"] in group for run in row["similar"]]
        files = sorted({f"{run['student']}: {run['other_file']}" for run in runs})
        percent = sorted({int(100 * run["share"]) for run in runs if not run["same_recording"]})
        texts = ["the same recording"] if any(run["same_recording"] for run in runs) else []
        texts += (
            [f"{' to '.join(map(str, dict.fromkeys((percent[0], percent[-1]))))} % same torques"] if percent else []
        )
        sentences.append(f"{'; '.join(files)}: {'; '.join(texts)}")
    return sorted(sentences)


def write_student_pages(
    folder: Path,
    out: Path,
    document: Mapping[str, Any],
    assignment: Assignment,
    students: Sequence[Student],
    names: Mapping[str, str],
    *,
    workers: int | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> None:
    """Write the page of each student.

    Args:
        folder: the graded recordings.
        out: folder of the pages.
        document: content of `grades.json`.
        assignment: the assignment.
        students: the students whose pages are written.
        names: file name of each page by id.
        workers: number of processes; None: one per core.
        on_progress: called with the completed share, 0 to 1.

    Raises:
        OperationError: a page can't be written.
    """
    by_id = {row["id"]: row for row in document["students"]}
    rows = [by_id[student.id] for student in students]
    introductions = [_introduction(student, row, document) for student, row in zip(students, rows, strict=True)]
    attempts = [used_attempt(row) for row in rows]
    runs = [() if attempt is None else tuple(folder / file for file in attempt["files"]) for attempt in attempts]
    titles = [f"{document['assignment']}: {student.name}" for student in students]
    with process_pool(len(students), workers) as executor:
        pages = executor.map(_student_page, titles, runs, introductions, repeat(assignment.task))
        for done, (student, page) in enumerate(zip(students, pages, strict=True), start=1):
            (out / names[student.id]).write_text(page, encoding="utf-8")
            if on_progress is not None:
                on_progress(done / len(students))


def _student_page(title: str, files: RunFiles, introduction: str, task: TaskConfig) -> str:
    if files:
        try:
            return build_report([files], task=task, title=title, introduction=introduction).html
        except HilrigError as error:
            introduction += f'<section><p class="bad">{as_html(str(error))}</p></section>'
    return _page(title, f"<h1>{as_html(title)}</h1>{introduction}")


def _introduction(student: Student, row: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    """Grade, goals and next step of a student as HTML."""
    points = "no grade" if row["points"] is None else f"{row['points']:g} of {document['points']:g} points"
    attempt = used_attempt(dict(row))
    goals = "".join(
        f'<li class="{"good" if goal["reached"] else "bad"}">{as_html(goal["name"])}: '
        f"{'reached' if goal['reached'] else 'missed'}, {as_html(goal['text'])}</li>"
        for goal in (attempt or {"goals": ()})["goals"]
    )
    facts = [f"{len(row['attempts'])} attempt{'s' * (len(row['attempts']) != 1)}"]
    if attempt is not None:
        facts.append(f"graded: {attempt['file']}")
    facts += [f"{each['file']}: {each['problem']}" for each in row["attempts"] if each["problem"]]
    return (
        f"<section><h2>{as_html(points)}</h2>"
        f'<p class="quiet">{as_html(student.id)} · {as_html("; ".join(facts))}</p>'
        f"<p>{as_html(feedback(dict(row), dict(document)))}</p>"
        f"{f'<ul>{goals}</ul>' if goals else ''}<p><b>Next step:</b> {as_html(next_step(row))}</p></section>"
    )


def next_step(row: Mapping[str, Any]) -> str:
    """The next thing to work on, from the attempt that counts."""
    attempt = used_attempt(dict(row))
    if attempt is None:
        if row["attempts"]:
            return f"hand in a run that can be read: {row['attempts'][-1]['problem']}."
        return "hand in a recording of a run."
    missed = [goal for goal in attempt["goals"] if not goal["reached"]]
    if missed:
        return f"{missed[0]['name']}: {missed[0]['text']}. Go to the time of its last approach in the plots below."
    if attempt["data_quality"]:
        return f"all goals are reached. The latency was not measured: {attempt['data_quality']}."
    return "all goals are reached. Compare age and energy with those of another attempt."


def _class_row(student: Student, row: Mapping[str, Any], page: str) -> str:
    attempt = used_attempt(dict(row))
    goals = (
        "–" if attempt is None else f"{sum(goal['reached'] for goal in attempt['goals'])} of {len(attempt['goals'])}"
    )
    notes = []
    if row["override"] is not None:
        notes.append(f"set manually: {row['override']['reason']}")
    if attempt is not None and row["penalty"]:
        notes.append(f"late, {row['penalty']:.0%} subtracted")
    if attempt is not None and row["penalty"] is None:
        notes.append("too late")
    if attempt is not None and attempt["data_quality"]:
        notes.append("latency not valid")
    notes += [f"{each['file']}: {each['problem']}" for each in row["attempts"] if each["problem"]]
    if row["similar"]:
        notes.append("see runs to compare")
    name = as_html(f"{student.name} ({student.id})")
    cells = (
        f'<a href="{as_html(page)}">{name}</a>' if page else name,
        as_html(student.group or "–"),
        "–" if row["points"] is None else f"{row['points']:g}",
        goals,
        str(len(row["attempts"])),
    )
    return (
        "<tr>"
        + "".join(f"<td>{cell}</td>" for cell in cells)
        + f'<td class="text">{as_html("; ".join(notes))}</td></tr>'
    )


def _section(title: str, sentences: Sequence[str], note: str) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{as_html(sentence)}</li>" for sentence in sentences)
    return f'<section><h2>{title}</h2><p class="quiet">{note}</p><ul>{items}</ul></section>'


def _page(title: str, body: str) -> str:
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{as_html(title)}</title><style>{assets.style()}</style></head><body>{body}</body></html>\n"
    )
