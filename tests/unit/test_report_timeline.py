"""Columns of a run in a report page: bounded, complete, and the same values as in the recording."""

import base64
import hashlib
import json
import re
import tomllib
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from hilrig_replay.analysis.summary import summarize
from hilrig_replay.geometry.scene import parameters_of
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.report.report import build_report
from hilrig_replay.report.timeline import timeline
from support.recordings import Script, make, record, write

VENDOR = files("hilrig_replay.report") / "vendor"
SCRIPT = (files("hilrig_replay.report") / "static/report.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(record(tmp_path_factory.mktemp("run") / "run.mcap", Script(seconds=6.0, delay_ms=25.0)))


def columns(run: Run, max_rows: int = 30_000) -> dict[str, Any]:
    summary = summarize(run)
    return timeline(run, summary.latency, parameters_of(run.parameters_json), None, summary.grade, max_rows=max_rows)


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_timeline_has_the_values_of_the_recording(run: Run) -> None:
    found = columns(run)
    assert found["every"] == 1
    np.testing.assert_allclose(floats(found["time"]), run.time_s(run.states), atol=1e-5)
    np.testing.assert_allclose(floats(found["position"][0]), np.degrees(run.states["position"][:, 0]), atol=1e-4)
    np.testing.assert_allclose(floats(found["position"][2]), 1e3 * run.states["position"][:, 2], atol=1e-3)
    np.testing.assert_allclose(floats(found["effort"][1]), run.states["effort"][:, 1], atol=1e-5)
    samples = found["samples"]
    total = np.sum([floats(stage) for stage in samples["stages"]], axis=0)
    np.testing.assert_allclose(total, floats(samples["loop"]), atol=1e-3)


@pytest.mark.parametrize("max_rows", [100, 37, 1])
def test_bins_keep_the_largest_age_and_latency(run: Run, max_rows: int) -> None:
    whole, found = columns(run), columns(run, max_rows)
    assert len(floats(found["time"])) <= max_rows
    assert len(floats(found["samples"]["time"])) <= max_rows
    assert np.nanmax(floats(found["age"])) == np.nanmax(floats(whole["age"]))
    assert floats(found["samples"]["loop"]).max() == floats(whole["samples"]["loop"]).max()


def test_ages_are_at_the_steps_of_their_states(run: Run) -> None:
    ages = floats(columns(run)["age"])
    report = summarize(run).latency
    assert report.age_ms is not None
    assert np.nanmean(ages) == pytest.approx(report.age_ms.mean, rel=1e-5)
    assert np.isnan(ages[0])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Report page of a run with a task whose title ends an element."""
    lab = "[task]\ntitle = '</script><b>'\n[[task.poses]]\nname = 'a'\nposition_mm = [400, 100, 50]\n"
    script = Script(seconds=2.0)
    path = write(tmp_path_factory.mktemp("page") / "run.mcap", make(script), script=script, lab_toml=lab)
    return build_report([path]).html


def test_page_values_are_json_and_can_not_end_their_element(page: str) -> None:
    (values,) = re.findall(r'<script type="application/json" id="run-1-data">(.*?)</script>', page)
    assert json.loads(values)["goals"] == [{"name": "a", "time": None}]
    assert "</script><b>" not in page


def test_fields_that_the_script_reads_are_sent(run: Run) -> None:
    found = columns(run)
    read = set(re.findall(r"\brun\.(\w+)", SCRIPT)) - {"id", "end", "tool", "trail", "poseOf"}
    assert {"time", "position", "events", "goals"} <= read <= found.keys()
    scene = set(re.findall(r"\bscene\.(\w+)", SCRIPT))
    assert {"reach", "links", "shoulder"} <= scene <= found["scene"].keys()


def test_vendored_files_are_unchanged_and_licensed(page: str) -> None:
    for package in tomllib.loads((VENDOR / "VENDOR.toml").read_text())["packages"]:
        for name, digest in package["sha256"].items():
            assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == digest, name
        assert f"{package['name'].lower()}-{package['version']}" in {child.name for child in VENDOR.iterdir()}
    assert "The MIT License (MIT)" in page


def test_scripts_of_the_page_match_its_security_policy(page: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "connect-src" not in policy[1]
    for script in re.findall(r"<script>(.*?)</script>", page, re.DOTALL):
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy[1]
