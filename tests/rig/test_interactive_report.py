"""The interactive part of a report in a browser: player, plots, events, print and dark mode."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.report.timeline import MAX_ROWS
from support.browser import CHROMIUM, Browser
from support.labs import hilrig
from support.recordings import Script, make, write
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")]

PLAYER = "document.querySelector('.player').player"
TASK = "[task]\ntitle = 'There'\n[[task.poses]]\nname = 'a'\nposition_mm = [400, 100, 50]\ntolerance_mm = 300\n"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    script = Script(seconds=12.0)
    run = write(folder / "run.mcap", make(script), script=script, lab_toml=TASK)
    result = hilrig("report", run, "--out", folder / "report.html")
    assert result.returncode == 0, result.stderr
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.parametrize("width", [390, 1280, 1920])
def test_player_fits_the_page_and_draws(page: Path, browser: Browser, width: int) -> None:
    browser.open(page.as_uri(), width=width)
    assert browser.errors == []
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run(f"{PLAYER}.plots.charts.length") == 5
    pixels = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.buffer"
    canvases = "[...document.querySelectorAll('canvas')]"
    assert browser.run(f"{canvases}.every(canvas => new Set(new Uint32Array({pixels})).size > 2)")
    assert browser.run(f"{canvases}.every(canvas => canvas.getBoundingClientRect().right <= innerWidth)")


def test_slider_moves_arm_values_and_time_marks(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    picture = "document.querySelector('.views canvas').toDataURL()"
    before = browser.run(picture)
    browser.run("slider = document.querySelector('.bar input'); slider.value = 6")
    browser.run("slider.dispatchEvent(new Event('input'))")
    assert browser.run(picture) != before
    assert browser.run("document.querySelector('.time').textContent").startswith("6.00 s of ")
    angle = float(browser.run("document.querySelector('.values tbody td').textContent"))
    row = browser.run(f"indexAt({PLAYER}.run.time, 6)")
    assert angle == pytest.approx(browser.run(f"{PLAYER}.run.position[0][{row}]"), abs=0.006)
    # The time marks of all plots are at the same place: their time axes are aligned.
    places = browser.run("[...document.querySelectorAll('.playhead')].map(each => each.getBoundingClientRect().left)")
    assert len(places) == 5
    assert max(places) - min(places) <= 1


def test_zoom_of_one_plot_zooms_all(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    browser.run(f"void {PLAYER}.plots.charts[2].setScale('x', {{min: 2, max: 4}})")
    ranges = f"{PLAYER}.plots.charts.map(chart => [chart.scales.x.min, chart.scales.x.max])"
    eventually(lambda: browser.run(ranges) == [[2, 4]] * 5)
    browser.run("[...document.querySelectorAll('button')].find(each => each.textContent === 'Whole run').click()")
    end = browser.run(f"{PLAYER}.run.end")
    eventually(lambda: browser.run(ranges) == [[0, end]] * 5)


def test_playing_advances_and_stops_at_the_end(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    browser.run(
        f"{PLAYER}.speed.value = '10'; {PLAYER}.seek({PLAYER}.run.end - 3); document.querySelector('.play').click()"
    )
    eventually(lambda: not browser.run(f"{PLAYER}.playing"))
    assert browser.run(f"{PLAYER}.at") == browser.run(f"{PLAYER}.run.end")
    assert browser.run("document.querySelector('.play').textContent") == "Play"


def test_event_in_the_list_leads_to_its_time(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    times = browser.run("[...document.querySelectorAll('.events button')].map(each => Number(each.dataset.time))")
    assert times
    browser.run("[...document.querySelectorAll('.events button')].at(-1).click()")
    assert browser.run(f"{PLAYER}.at") == pytest.approx(min(max(times[-1], 0), browser.run(f"{PLAYER}.run.end")))


def test_value_that_is_rounded_to_zero_has_no_sign(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    values = browser.run("[fixed(-0.004, 2), fixed(-0.006, 2), fixed(-0.4, 0), fixed(-10, 0), fixed(0, 1)]")
    assert values == ["0.00", "-0.01", "0", "-10", "0.0"]


def test_keys_move_by_one_state(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())

    def press(key: str) -> float:
        event = f"new KeyboardEvent('keydown', {{key: '{key}', cancelable: true}})"
        browser.run(f"document.querySelector('.bar input').dispatchEvent({event})")
        return float(browser.run(f"{PLAYER}.at"))

    assert press("ArrowRight") == pytest.approx(0.02, abs=1e-3)
    assert press("PageDown") == pytest.approx(1.02, abs=1e-3)
    assert press("ArrowLeft") == pytest.approx(1.0, abs=1e-3)


def test_dark_page_is_dark_and_paper_has_still_pictures(page: Path, browser: Browser) -> None:
    browser.emulate(scheme="dark")
    browser.open(page.as_uri())
    assert np.median(browser.screenshot()) < 0.2
    browser.emulate(media="print")
    shown = "[...document.images].map(image => image.getBoundingClientRect().width > 50)"
    assert browser.run(shown) == [True] * 4
    assert browser.run("document.querySelector('.player').getBoundingClientRect().height") == 0
    assert np.median(browser.screenshot()) > 0.95
    browser.emulate()
    assert browser.run(shown) == [False, False, True, True]


SCRUB = """new Promise(done => {
  const player = %s, begin = performance.now();
  let frames = 0;
  function frame() {
    const passed = performance.now() - begin;
    if (passed > 3000) return done(frames / (passed / 1000));
    player.slider.value = player.run.end * ((frames++ * 7) %% 300) / 300;
    player.slider.dispatchEvent(new Event('input'));
    requestAnimationFrame(frame);
  }
  requestAnimationFrame(frame);
})"""


@pytest.mark.long("takes 20 s")
def test_ten_minutes_are_small_and_scrubbed_smoothly(tmp_path: Path, browser: Browser) -> None:
    script = Script(seconds=600.0, poll_ms=20.0)
    run = write(tmp_path / "run.mcap", make(script), script=script, lab_toml=TASK)
    assert hilrig("report", run, "--out", tmp_path / "report.html").returncode == 0
    assert (tmp_path / "report.html").stat().st_size < 15e6
    browser.open((tmp_path / "report.html").as_uri(), width=1280)
    rows = browser.run(f"{PLAYER}.run.time.length")
    # Every state is shown.
    assert 30_000 <= rows <= MAX_ROWS
    reply = browser._call("Runtime.evaluate", expression=SCRUB % PLAYER, awaitPromise=True, returnByValue=True)
    assert reply["result"]["value"] >= 30.0
    assert browser.errors == []
