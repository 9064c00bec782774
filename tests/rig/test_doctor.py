"""`hilrig doctor` and `hilrig router` from the command line, with running services."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.counters import Counters
from hilrig_runtime.process.discovery import list_services, query_services
from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    with RunningLab(write_lab(tmp_path_factory.mktemp("doctor"), rigs=2)) as running:
        yield running


def results(done: subprocess.CompletedProcess[str]) -> dict[str, list[dict[str, Any]]]:
    """Results of the checks, by the name of the check."""
    found: dict[str, list[dict[str, Any]]] = {}
    for result in json.loads(done.stdout)["findings"]:
        found.setdefault(result["check"], []).append(result)
    return found


def test_running_lab_has_no_errors(lab: RunningLab) -> None:
    done = hilrig("doctor", "--config", lab.config, "--json", cwd=lab.config.parent)
    assert done.returncode == 0, done.stdout
    found = results(done)
    assert json.loads(done.stdout)["well"] is True
    assert "2 of 2 Modbus ports served by hilrig" in found["ports"][0]["text"]
    assert all(name in found["services"][0]["text"] for name in ("sim/1", "edge/1", "recorder/1"))
    assert len(found["real-time"]) in (1, 2)
    assert "edge/1" in "".join(result["text"] for result in found["real-time"])
    assert found["versions"][0]["level"] == found["time"][0]["level"] == "ok"
    table = hilrig("doctor", "--config", lab.config, cwd=lab.config.parent)
    assert table.returncode == 0
    assert "no errors" in table.stdout


@contextmanager
def stopped(lab: RunningLab, service: str) -> Iterator[None]:
    """Stop a service: it has no time to answer."""
    pid = lab.service_pid(service)
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def test_stopped_service_shifts_no_clock_of_others(lab: RunningLab) -> None:
    # The bus is closed last: it waits for the stopped service.
    with ZenohBus(lab.lab.bus, "tool") as bus:
        eventually(lambda: len(list_services(bus, lab.lab)) == 3)
        with stopped(lab, "recorder"):
            replies = query_services(bus, lab.lab.name, "*", Counters(), 1.5)
            found = {info.service: offset for info, offset in replies}
    assert set(found) == {"sim", "edge"}
    for offset in found.values():
        assert abs(offset.offset_ns) <= offset.uncertainty_ns < 300_000_000


@pytest.mark.long("takes 15 s")
def test_top_shows_true_clocks_while_a_service_is_stopped(lab: RunningLab) -> None:
    """After each service has compared its clock, which it does every 10 s."""
    with stopped(lab, "recorder"):
        deadline_s = time.monotonic() + 15
        while time.monotonic() < deadline_s:
            done = hilrig("top", "--config", lab.config, "--json")
            assert done.returncode == 0, done.stderr
            shown = json.loads(done.stdout)["services"]
            clocks = [row for row in shown if row["service"] != "recorder" and row["clock_peer"]]
            assert len(clocks) == 2
            for row in clocks:
                assert abs(row["clock_offset_ms"]) <= row["clock_uncertainty_ms"] < 300
        found = results(hilrig("doctor", "--config", lab.config, "--json", cwd=lab.config.parent))
        assert found["time"][0]["level"] == "ok"


@pytest.mark.parametrize("service", ["sim", "edge", "recorder"])
def test_health_check_of_one_service(lab: RunningLab, service: str) -> None:
    done = hilrig("doctor", "--service", service, "--config", lab.config, "--json")
    assert done.returncode == 0, done.stdout
    assert f"{service}/1: running for" in results(done)[service][0]["text"]


def test_health_check_of_a_missing_instance_fails(lab: RunningLab) -> None:
    done = hilrig("doctor", "--service", "edge", "--instance", "east", "--config", lab.config)
    assert done.returncode == 1
    assert "no health report from edge/east" in done.stdout
    assert "restart" not in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["doctor", "--service", "toaster"], "expected sim, edge, recorder or router"),
        (["doctor", "--service", "router"], "this lab has no router"),
        (["router"], "this lab has no router"),
        (["router", "--print"], "this lab has no router"),
    ],
)
def test_invalid_request_is_reported_in_one_line(lab: RunningLab, arguments: list[str], message: str) -> None:
    done = hilrig(*arguments, "--config", lab.config)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def routed(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(f'[bus]\ntopology = "router"\nrouter = "tcp/127.0.0.1:{free_ports(1)}"\n')
    return path


def test_missing_router_is_an_error_and_missing_services_are_not(routed: Path) -> None:
    alone = hilrig("doctor", "--config", routed, "--json", cwd=routed.parent)
    assert alone.returncode == 1
    assert "no zenoh router answers" in results(alone)["bus"][0]["text"]
    assert "services" not in results(alone), "services are unknown without the bus"
    command = [*HILRIG, "router", "--stop-with-parent", "--config", str(routed)]
    with ForkedPopen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as router:
        assert router.stdout is not None
        assert router.stdout.readline().startswith("router of lab 'lab' at tcp/127.0.0.1:")
        assert hilrig("doctor", "--service", "router", "--config", routed).returncode == 0
        second = hilrig("router", "--config", routed)
        assert second.returncode == 3
        assert "the router can't listen on tcp/127.0.0.1" in second.stderr
        with_it = hilrig("doctor", "--config", routed, "--json", cwd=routed.parent)
        assert with_it.returncode == 0, with_it.stdout
        assert "no service of lab 'lab' is running" in results(with_it)["services"][0]["text"]
        router.terminate()
        assert router.wait(LONG_TIMEOUT_S) == 0
    assert hilrig("doctor", "--service", "router", "--config", routed).returncode == 1


def test_table_shows_toml_headers_unchanged(tmp_path: Path) -> None:
    done = hilrig("doctor", "--config", write_lab(tmp_path, extra="edge.host = '0.0.0.0'"), cwd=tmp_path)
    assert "[edge.tls]" in done.stdout


def test_printed_router_configuration_is_valid_json(routed: Path) -> None:
    printed = hilrig("router", "--config", routed, "--print")
    assert printed.returncode == 0, printed.stderr
    config = json.loads(printed.stdout)
    assert config["mode"] == "router"
    assert config["scouting"]["multicast"]["enabled"] is False
    wrong = hilrig("router", "--config", routed, "--listen", "tls/0.0.0.0:7447")
    assert wrong.returncode == 2
    assert "must be tcp/<address>:<port>" in wrong.stderr
