"""`hilrig demo`: its output, exit code and result files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.run import open_run
from support.labs import hilrig

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("demo")
    done = hilrig("demo", "--out", out / "out", "--json", cwd=out)
    assert done.returncode == 0, done.stderr
    return out / "out", json.loads(done.stdout)


def test_result_files_exist(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    for key in ("recording", "rrd", "plot"):
        assert Path(result[key]).stat().st_size > 10_000


def test_latency_equals_the_result_of_hilrig_latency(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    again = hilrig("latency", result["recording"], "--json")
    latency = json.loads(again.stdout)
    assert latency == {"schema": "hilrig.latency/1", **result["latency"]}
    assert {"samples", "loop_ms", "stages_ms", "step_ms", "lost", "fit", "reasons"} <= set(latency)
    assert set(latency["lost"]) == {"transport", "recorder", "file"}
    assert set(latency["stages_ms"]) == set(STAGES)
    statistics = {"p50", "p95", "p99", "p999", "max", "mean", "std"}
    assert all(statistics <= set(figures) for figures in (latency["loop_ms"], *latency["stages_ms"].values()))
    assert again.returncode == (0 if latency["fit"] else 1)


def test_stages_of_each_sample_sum_to_the_loop_latency(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    samples = measure(open_run(result["recording"])).table
    assert len(samples) == result["latency"]["samples"] > 300
    assert np.array_equal(sum(samples[stage] for stage in STAGES), samples["loop"])
    for stage in STAGES:
        assert samples[stage].min() >= 0, stage


def test_nothing_is_lost(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    assert result["latency"]["lost"] == {"transport": 0, "recorder": 0, "file": 0}


def test_recording_is_verified_and_every_part_is_placed(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    assert result["verify"]["exact"]
    assert result["task"]["placed"] == len(result["task"]["parts"]) == 4
    assert result["task"]["largest_error_mm"] < 2.0
    assert (result["task"]["missing"], result["task"]["why"], result["controller"]["missing"]) == ([], "", [])


def test_recording_is_readable_with_the_mcap_library(demo: tuple[Path, dict[str, Any]]) -> None:
    _, result = demo
    with Path(result["recording"]).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert {channel.topic for channel in summary.channels.values()} >= {"/state", "/command", "/event"}
        names = {record.name for record in reader.iter_metadata()}
        assert names >= {"hilrig.session", "hilrig.config", "hilrig.summary"}
        attachments = {attachment.name for attachment in reader.iter_attachments()}
        assert {"lab.toml", "rig1.urdf"} <= attachments
        steps = [decoded.step for _, _, _, decoded in reader.iter_decoded_messages(topics=["/state"])]
    assert steps == list(range(steps[0], steps[0] + len(steps)))


def test_loop_that_never_closes_is_exit_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The controller writes without reading: its commands are based on no state, so there is no latency sample.
    from hilrig_cli.local import demo as module

    controller = tmp_path / "never_reads.py"
    controller.write_text(
        "import sys, time\n"
        "from pymodbus.client import ModbusTcpClient\n"
        "port = int(sys.argv[sys.argv.index('--port') + 1])\n"
        "with ModbusTcpClient('127.0.0.1', port=port) as client:\n"
        "    client.write_coil(0, True)\n"
        "    time.sleep(1)\n"
        "print('{}')\n"
    )
    monkeypatch.setattr(module, "example_path", lambda _: controller)
    from typer.testing import CliRunner

    from hilrig_cli.main import app

    done = CliRunner().invoke(app, ["demo", "--duration", "1", "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 1, done.output
