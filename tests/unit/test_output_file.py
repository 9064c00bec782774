"""Output files: written beside the target and renamed; an input or a recording is never replaced."""

import os
from pathlib import Path

import pytest

from hilrig_cli.local.demo import run_demo
from hilrig_replay.export.export import export_tables
from hilrig_replay.io.output_file import check_output, output_file
from hilrig_replay.io.run import open_run
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_runtime.errors import InputError, OperationError
from support.recordings import Script, record


def test_target_is_replaced_only_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    target.write_text("before")

    def interrupted() -> None:
        with output_file(target) as temporary:
            temporary.write_text("half")
            assert target.read_text() == "before"
            raise ValueError("interrupted")

    with pytest.raises(ValueError, match="interrupted"):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    with output_file(target) as temporary:
        temporary.write_text("after")
    assert target.read_text() == "after"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_input_is_never_replaced_under_any_name(tmp_path: Path) -> None:
    given = tmp_path / "study.toml"
    given.write_text("input")
    (tmp_path / "hard").hardlink_to(given)
    (tmp_path / "soft").symlink_to(given)
    for name in ("study.toml", "hard", "soft", "../" + tmp_path.name + "/study.toml"):
        with pytest.raises(InputError, match="is an input of this command and is not overwritten"):
            check_output(tmp_path / name, [tmp_path / "missing", given])


def test_damaged_recording_is_not_replaced(tmp_path: Path) -> None:
    run = record(tmp_path / "run.mcap", Script(seconds=0.5))
    damaged = tmp_path / "first-bytes-zeroed.mcap"
    damaged.write_bytes(bytes(4096) + run.read_bytes()[4096:])
    renamed = tmp_path / "run.bin"
    renamed.write_bytes(run.read_bytes())
    for path in (damaged, renamed):
        with pytest.raises(InputError, match="is a recording and is not overwritten"):
            save_rrd(open_run(run), path)
    assert not list(tmp_path.glob(".hilrig-*"))


def test_tables_never_replace_their_recording(tmp_path: Path) -> None:
    run = record(tmp_path / "event.csv", Script(seconds=0.5))
    before = run.read_bytes()
    with pytest.raises(InputError, match=r"event\.csv is an input"):
        export_tables(open_run(run), tmp_path, "csv")
    assert run.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["event.csv"]


def test_recording_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "run.mcap"

    def write() -> None:
        with output_file(target) as temporary:
            temporary.write_text("result")
            record(target, Script(seconds=0.5))

    with pytest.raises(InputError, match="is a recording"):
        write()
    assert open_run(target).file.counts["state"] > 0


def test_device_is_written_directly(tmp_path: Path) -> None:
    link = tmp_path / "null"
    link.symlink_to("/dev/null")
    with output_file(link) as temporary:
        temporary.write_text("x")
    assert link.is_symlink()
    assert Path("/dev/null").is_char_device()


def test_longest_possible_name_is_written(tmp_path: Path) -> None:
    target = tmp_path / ("x" * 250 + ".html")
    with output_file(target) as temporary:
        temporary.write_text("x")
    assert target.read_text() == "x"
    with pytest.raises(InputError, match="File name too long"):
        check_output(tmp_path / ("x" * 300))


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        folder = Path("/proc")
    else:
        folder = tmp_path
        folder.chmod(0o500)
    with pytest.raises(OperationError, match="can't be written"), output_file(folder / "page.html"):
        pass


def test_demo_keeps_the_files_of_another_lab(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text('name = "course"\n')
    kept = tmp_path / "recordings" / "course" / "rig1" / "run.mcap"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"data")
    with pytest.raises(InputError, match="is not of a demo and is not overwritten"):
        run_demo(0.1, tmp_path, print, print)
    assert kept.read_bytes() == b"data"
    assert (tmp_path / "lab.toml").read_text() == 'name = "course"\n'
