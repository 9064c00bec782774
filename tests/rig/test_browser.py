"""The report and the web viewer in a browser."""

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.plots.palette import JOINT_COLORS, rgb
from support.browser import CHROMIUM, Browser, share_of
from support.hilrig_process import HILRIG
from support.labs import hilrig
from support.recordings import Script, make, record, write
from support.waiting import LONG_TIMEOUT_S

pytestmark = [pytest.mark.rig, pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")]

TASK = "[task]\ntitle = 'There'\n[[task.poses]]\nname = 'a'\nposition_mm = [400, 100, 50]\ntolerance_mm = 300\n"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, script in (("quick", Script(seconds=12.0)), ("slow", Script(seconds=12.0, delay_ms=40.0))):
        made = make(script, session=name)
        write(folder / f"{name}.mcap", made, script=script, session=name, lab_toml=TASK)
    return folder


@pytest.fixture(scope="module")
def report(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("report") / "report.html"
    result = hilrig("report", runs / "quick.mcap", "--out", page)
    assert (result.returncode, result.stdout.strip()) == (0, str(page)), result.stderr
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.parametrize("width", [1200, 420])
def test_report_layout_and_no_network_requests(report: Path, browser: Browser, width: int) -> None:
    browser.open(report.as_uri(), width=width, height=2400)
    assert browser.errors == []
    assert all(address.startswith(("file:", "data:")) for address in browser.requests)
    assert browser.run("[...document.images].every(image => image.complete && image.naturalWidth > 400)")
    assert browser.run("document.images.length") == 4
    assert browser.run("[...document.images].every(image => image.getBoundingClientRect().right <= innerWidth)")
    # On a narrow page the images are below each other; those of the motion are for paper.
    shown = "[...document.images].map(image => image.getBoundingClientRect()).filter(box => box.width)"
    rows = browser.run(f"new Set({shown}.map(box => box.top)).size")
    assert rows == (1 if width > 700 else 2)
    # No horizontal overflow: wide tables scroll within their sections.
    assert browser.run("document.documentElement.scrollWidth") <= width
    text = browser.run("document.body.innerText")
    for expected in ("Task: There", "passed", "register wait", "controlled by 192.0.2.7:40001"):
        assert expected in text, expected
    picture = browser.screenshot()
    # White sections on a gray page, with lines in the joints' colors.
    assert (picture > 0.99).all(axis=-1).mean() > 0.3
    for color in JOINT_COLORS:
        near = np.abs(picture - np.array(rgb(color)) / 255).max(axis=-1) < 0.12
        assert near.sum() > 20, color


def test_group_report_has_ranking_and_expandable_runs(runs: Path, browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "group.html"
    assert hilrig("report", runs, "--out", page).returncode == 0
    browser.open(page.as_uri())
    assert browser.errors == []
    assert browser.run("document.querySelectorAll('details').length") == 2
    assert browser.run("document.querySelectorAll('section table tbody tr').length") >= 2
    before = browser.run("document.body.scrollHeight")
    browser.run("document.querySelector('summary').click()")
    assert browser.run("document.querySelector('details').open")
    assert browser.run("document.body.scrollHeight") > before + 500
    # On a narrow page no image overflows its section or scrolls: its panels are below each other.
    browser.open(page.as_uri(), width=420)
    assert browser.run("document.documentElement.scrollWidth") <= 420
    assert browser.run("document.querySelectorAll('.scroll img').length") == 0
    # Tables do not scroll either: the ranking becomes cards with labeled values.
    browser.run("document.querySelectorAll('details').forEach(each => { each.open = true })")
    assert browser.run("[...document.querySelectorAll('.scroll')].every(each => each.scrollWidth <= each.clientWidth)")
    card_label = browser.run("getComputedStyle(document.querySelector('.ranking td + td'), '::before').content")
    assert card_label.strip('"') in {"goals", "parts placed"}
    browser.run("document.querySelectorAll('details').forEach(each => { each.open = false })")
    panels = browser.run(
        "[...document.querySelector('section').querySelectorAll('img')].map(image => image.getBoundingClientRect())"
        ".map(box => [box.left, box.right, box.top, box.bottom])"
    )
    assert len(panels) == 4
    assert all(left >= 0 and right <= 420 for left, right, _, _ in panels)
    assert all(below[2] >= above[3] for above, below in pairwise(panels))


@pytest.mark.timeout(300)
def test_web_viewer_shows_the_arm_using_loopback_only(tmp_path: Path) -> None:
    run = record(tmp_path / "run.mcap", Script(seconds=6.0))
    process = subprocess.Popen(
        [*HILRIG, "replay", str(run), "--web"], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stderr is not None
        announced = re.match(r"open (http://127\.0\.0\.1:\S+) ", process.stderr.readline())
        assert announced is not None
        with Browser(tmp_path / "browser", graphics=True) as browser:
            browser.open(announced[1], width=560, height=336)

            def arm_on_its_table(picture: np.ndarray) -> bool:
                scene = picture[: int(0.7 * len(picture)), : int(0.55 * picture.shape[1])]
                table = share_of(scene, (0.75, 1), (0.7, 1), (0.6, 0.9))
                return table > 0.05 and share_of(scene, (0.6, 1), (0.35, 0.75), (0, 0.45)) > 0.003

            # Rendered in software, possibly on a busy machine.
            picture = browser.until(arm_on_its_table, timeout_s=240)
            curves = picture[:, int(0.6 * picture.shape[1]) :]
            assert len(np.unique((curves.reshape(-1, 3) * 7).astype(np.uint8), axis=0)) > 10
            elsewhere = [one for one in browser.requests if not re.match(r"(http://127\.0\.0\.1:|data:|blob:)", one)]
            assert elsewhere == [], elsewhere
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_TIMEOUT_S) == 0
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if process.stderr is not None:
            process.stderr.close()
