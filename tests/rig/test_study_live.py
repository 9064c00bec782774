"""The live loop beside its twins in virtual time: `hilrig study --live` on a lab of its own, over real Modbus TCP."""

import json
from pathlib import Path

import pytest

from support.labs import hilrig

pytestmark = [pytest.mark.rig, pytest.mark.alone]

STUDY = """
title = "Virtual and live"
live_duration_s = 4
[task]
amplitude = [3, 3, 0, 3]
frequency_hz = 0.5
[x]
what = "delay_ms"
values = [0, 50]
[y]
what = "jitter_ms"
values = [0, 40]
[[controllers]]
name = "PD"
kind = "pd"
kp = [11.5, 7.0, 30.0, 0.25]
kd = [2.3, 1.45, 2.0, 0.03]
[[controllers]]
name = "mine"
kind = "file"
file = "mine.py"
[[live]]
x = 0
y = 0
[[live]]
x = 50
y = 40
[[live]]
x = 50
y = 0
controller = "mine"
"""


@pytest.mark.timeout(300)
def test_live_points_do_what_virtual_time_says(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    example = Path(__file__).parents[2] / "examples" / "controllers" / "pd.py"
    (tmp_path / "mine.py").write_text(example.read_text().replace("KP = (23.0, 14.0", "KP = (11.0, 7.0"))
    out = tmp_path / "out"
    done = hilrig("study", tmp_path / "study.toml", "--live", "--out", out, "--json", timeout_s=180)
    assert done.returncode in (0, 1), done.stderr
    points = json.loads(done.stdout)["live"]
    assert [(point["controller"], point["x"], point["y"]) for point in points] == [
        ("PD", 0, 0),
        ("PD", 50, 40),
        ("mine", 50, 0),
    ]
    for point in points:
        assert point["as_predicted"], point
        assert Path(point["recording"]).exists()
        live, virtual = point["live"], point["virtual"]
        assert live["loop_p50_ms"] == pytest.approx(virtual["loop_p50_ms"], abs=20.5)
        assert live["error_rms_deg"] == pytest.approx(virtual["error_rms_deg"], rel=0.2, abs=0.1)
    # Of its steps the loop is what was asked for; within one, a tick that the machine held up is seen.
    assert points[0]["live"]["loop_p50_ms"] == pytest.approx(20, abs=5)
    assert points[2]["live"]["loop_p50_ms"] == pytest.approx(60, abs=5)
    # The recording of a point is a recording like any other: what gains would it have borne?
    judged = hilrig("study", "--from", points[1]["recording"], "--json")
    assert judged.returncode == 0, judged.stderr
    gains = json.loads(judged.stdout)["gains"]
    assert gains[0]["stable"]
    assert not gains[-1]["stable"]
    assert gains[0]["mean_square_radius"] < 1 < gains[-1]["mean_square_radius"]
