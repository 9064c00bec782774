"""Text from outside is escaped for its renderer: terminal, HTML, matplotlib and spreadsheets."""

import csv
import io
import os
import shutil
import warnings
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from hilrig_cli.terminal import TerminalConsole
from hilrig_replay.analysis.latency import measure
from hilrig_replay.export.export import export_tables
from hilrig_replay.io.run import open_run
from hilrig_replay.plots.latency_plot import save_plot
from hilrig_replay.report.report import build_report
from hilrig_runtime.escaping import as_html, csv_text, plot_text, printable
from support import recordings
from support.in_process import hilrig_in_process
from support.labs import hilrig
from support.recordings import Script, record

NAMES = {
    "dollar": b"cost $x^{$ and $$.mcap",
    "latin-1": "Prüfung é.mcap".encode("latin-1"),
    "escape": b"\x1b[2J\x1b]0;title\x07.mcap",
    "newline": b"a\nb\r.mcap",
    "255 bytes": b"n" * 250 + b".mcap",
    "markup": b"[red]a[bold].mcap",
    "formula": b"=1+1.mcap",
    "HTML": b"<script>x.mcap",
    "dash": b"-o.mcap",
    "right-to-left": "a\u202epacm.mcap".encode(),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("good") / "run.mcap", Script(seconds=1.0))


def is_harmless(text: str) -> bool:
    return all(letter.isprintable() or letter == "\n" for letter in text)


@pytest.mark.timeout(300)
def test_commands_accept_any_file_name(tmp_path: Path, good: Path) -> None:
    folder = tmp_path / "lab"
    folder.mkdir()
    paths = {name: folder / os.fsdecode(encoded) for name, encoded in NAMES.items()}
    for path in paths.values():
        shutil.copy(good, path)
    every, longest = paths.values(), paths["255 bytes"]
    for_terminals = [paths[name] for name in ("escape", "newline", "right-to-left", "255 bytes")]
    for_pages = [paths[name] for name in ("dollar", "latin-1", "escape", "newline", "HTML", "right-to-left")]
    commands: list[tuple[list[str | Path], int]] = [
        (["latency", *every], 1),
        (["latency", *every, "--json"], 1),
        (["runs", folder], 0),
        (["report", *for_pages, "--out", tmp_path / "report.html"], 0),
        (["report", longest, "--out", folder / (longest.name[:-5] + ".html")], 0),
        (["compare", *for_terminals, "--align", "start"], 0),
        (["recover", *every], 0),
    ]
    commands += [(["export", path, "--csv", tmp_path / f"csv {name}"], 0) for name, path in paths.items()]
    # Each of the other renderers gets the names that it could take for something else.
    commands += [(["verify", path], 1) for path in for_terminals]
    for name in ("dollar", "latin-1", "newline"):
        commands.append((["latency", paths[name], "--plot", tmp_path / "plot.png"], 1))
    for arguments, code in commands:
        done = hilrig_in_process(*arguments)
        assert done.returncode == code, (arguments, done.stderr)
        assert is_harmless(done.stdout), done.stdout
        assert is_harmless(done.stderr), done.stderr
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    # Only the two scripts of the page, whose source has control characters of its own.
    content, *scripts = page.split("<script>")
    assert len(scripts) == 2
    assert is_harmless(content)


def test_error_about_a_file_shows_its_name_escaped(tmp_path: Path) -> None:
    done = hilrig("latency", tmp_path / "\x1b[2J.mcap")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "\\x1b[2J.mcap: no such file" in done.stderr
    assert is_harmless(done.stderr)


def test_printable_escapes_control_and_undecodable_characters() -> None:
    assert printable("علی\u200cرضا") == "علی\u200cرضا"
    assert printable("a\x1b[0m\n\x7f\x9b\u202e") == "a\\x1b[0m\\x0a\\x7f\\x9b\\u202e"
    assert printable(os.fsdecode(b"\xe9.mcap")) == "\\xe9.mcap"
    assert printable("τ1 … 5\u00a0ms, θ̇") == "τ1 … 5\u00a0ms, θ̇"
    assert printable("a\nb", keep="\n") == "a\nb"


def test_console_escapes_text_and_keeps_its_own_styles() -> None:
    out = io.StringIO()
    console = TerminalConsole(file=out, force_terminal=True, color_system="standard", width=80)
    console.print("\x1b]0;x\x07 [red]text[/red]", style="bold", highlight=False)
    assert "\x1b]" not in out.getvalue()
    assert "\\x1b]0;x" in out.getvalue()
    assert "[red]text[/red]" in out.getvalue().replace("\x1b[1m", "").replace("\x1b[0m", "")
    assert "\x1b[1m" in out.getvalue()


@pytest.mark.parametrize("text", ["$", "$x^{$", r"\$a$", "a\nb", "\x1b", os.fsdecode(b"\xe9$")])
def test_any_text_can_be_drawn(text: str) -> None:
    figure = Figure()
    figure.suptitle(plot_text(text))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.savefig(io.BytesIO())


def test_html_text_is_inert() -> None:
    assert as_html("<a href='x'>\"&\x00") == "&lt;a href=&#x27;x&#x27;&gt;&quot;&amp;\\x00"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\tx", "\rx"])
def test_formulas_are_texts_in_csv(tmp_path: Path, text: str) -> None:
    assert csv_text(text) == f"'{text}"
    made = recordings.make(Script(seconds=0.5))
    for one in made:
        if one.topic == "event":
            one.message.text = text  # type: ignore[attr-defined]
        elif one.topic == "state":
            one.message.held_part = text  # type: ignore[attr-defined]
    run = open_run(recordings.write(tmp_path / "run.mcap", made))
    export_tables(run, tmp_path, "csv")
    for table, column in (("event", "text"), ("state", "held_part")):
        with (tmp_path / f"{table}.csv").open(newline="", encoding="utf-8") as file:
            assert {row[column] for row in csv.DictReader(file)} == {f"'{text}"}


def test_session_of_a_recording_is_drawn_and_reported(tmp_path: Path) -> None:
    session = "$x^{ <b> \x1b[2J"
    made = recordings.make(Script(seconds=1.0), session=session)
    run = open_run(recordings.write(tmp_path / "run.mcap", made, session=session))
    save_plot(measure(run), run, tmp_path / "plot.png")
    page = build_report([run.path]).html
    assert "<b> " not in page
    assert "\x1b" not in page
