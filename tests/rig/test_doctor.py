"""`hilrig doctor` and `hilrig router` as a lab uses them: with real services, from the command line."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.labs import HILRIG, RunningLab, free_ports, hilrig, write_lab
from support.waiting import PATIENT_S

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    with RunningLab(write_lab(tmp_path_factory.mktemp("doctor"), rigs=2)) as running:
        yield running


def findings(done: subprocess.CompletedProcess[str]) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for finding in json.loads(done.stdout)["findings"]:
        found.setdefault(finding["check"], []).append(finding)
    return found


def test_a_lab_that_runs_is_well(lab: RunningLab) -> None:
    done = hilrig("doctor", "--config", lab.config, "--json", cwd=lab.config.parent)
    assert done.returncode == 0, done.stdout
    found = findings(done)
    assert json.loads(done.stdout)["well"] is True
    assert "2 of 2 Modbus ports served by hilrig" in found["ports"][0]["text"]
    assert all(name in found["services"][0]["text"] for name in ("sim/1", "edge/1", "recorder/1"))
    assert len(found["real-time"]) in (1, 2)
    assert "edge/1" in "".join(finding["text"] for finding in found["real-time"])
    assert found["versions"][0]["level"] == found["time"][0]["level"] == "good"
    table = hilrig("doctor", "--config", lab.config, cwd=lab.config.parent)
    assert table.returncode == 0
    assert "all is well" in table.stdout or "nothing is wrong" in table.stdout


@pytest.mark.parametrize("service", ["sim", "edge", "recorder"])
def test_a_health_check_asks_the_service_itself(lab: RunningLab, service: str) -> None:
    done = hilrig("doctor", "--service", service, "--config", lab.config, "--json")
    assert done.returncode == 0, done.stdout
    assert f"{service}/1 is well" in findings(done)[service][0]["text"]


def test_an_instance_that_is_not_there_is_not_well(lab: RunningLab) -> None:
    done = hilrig("doctor", "--service", "edge", "--instance", "east", "--config", lab.config)
    assert done.returncode == 1
    assert "no edge/east says how it is" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["doctor", "--service", "toaster"], "expected sim, edge, recorder or router"),
        (["doctor", "--service", "router"], "this lab has none"),
        (["router"], "this lab has no router"),
        (["router", "--print"], "this lab has no router"),
    ],
)
def test_what_cannot_be_asked_is_said_in_one_line(lab: RunningLab, arguments: list[str], said: str) -> None:
    done = hilrig(*arguments, "--config", lab.config)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def routed(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(f'[bus]\ntopology = "router"\nrouter = "tcp/127.0.0.1:{free_ports(1)}"\n')
    return path


def test_without_its_router_a_lab_is_not_well_and_with_it_nothing_runs(routed: Path) -> None:
    alone = hilrig("doctor", "--config", routed, "--json", cwd=routed.parent)
    assert alone.returncode == 1
    assert "no zenoh router answers" in findings(alone)["bus"][0]["text"]
    assert "services" not in findings(alone), "nobody can know whether they run"
    command = [*HILRIG, "router", "--stop-with-parent", "--config", str(routed)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as router:
        assert router.stdout is not None
        assert router.stdout.readline().startswith("router of lab 'lab' at tcp/127.0.0.1:")
        assert hilrig("doctor", "--service", "router", "--config", routed).returncode == 0
        second = hilrig("router", "--config", routed)
        assert second.returncode == 3
        assert "the router can't listen on tcp/127.0.0.1" in second.stderr
        with_it = hilrig("doctor", "--config", routed, "--json", cwd=routed.parent)
        assert with_it.returncode == 0, with_it.stdout
        assert "nothing of lab 'lab' runs" in findings(with_it)["services"][0]["text"]
        router.terminate()
        assert router.wait(PATIENT_S) == 0
    assert hilrig("doctor", "--service", "router", "--config", routed).returncode == 1


def test_what_is_to_be_written_into_the_file_stands_in_the_table_as_it_is_written(tmp_path: Path) -> None:
    done = hilrig("doctor", "--config", write_lab(tmp_path, extra="edge.host = '0.0.0.0'"), cwd=tmp_path)
    assert "[edge.tls]" in done.stdout


def test_the_configuration_for_zenohs_own_router_is_one(routed: Path) -> None:
    printed = hilrig("router", "--config", routed, "--print")
    assert printed.returncode == 0, printed.stderr
    config = json.loads(printed.stdout)
    assert config["mode"] == "router"
    assert config["scouting"]["multicast"]["enabled"] is False
    wrong = hilrig("router", "--config", routed, "--listen", "tls/0.0.0.0:7447")
    assert wrong.returncode == 2
    assert "expected tcp/<address>:<port>" in wrong.stderr
