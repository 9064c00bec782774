"""Tests of a lab with many rigs: partitioned among processes, monitored, with rigs added and removed at run time."""

import json
import os
import re
import signal
import socket
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import pytest
from pymodbus.client import ModbusTcpClient

from support.hilrig_process import HILRIG
from support.labs import RunningLab, free_ports, hilrig, steady_controller, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    config = write_lab(tmp_path_factory.mktemp("lab"), rigs=4, extra="edge.session_grace_ms = 100")
    with RunningLab(config, "--edges", "2", "--recorders", "2", "--log-format", "json") as running:
        yield running
    # Every line, of `up` and of each service, until the end.
    for line in running.output().splitlines():
        assert json.loads(line)["service"] in ("up", "sim", "edge", "recorder"), line


def top(lab: RunningLab) -> dict[str, Any]:
    done = hilrig("top", "--json", "--config", lab.config)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def rig_of(lab: RunningLab, name: str) -> dict[str, Any]:
    return next(rig for rig in top(lab)["rigs"] if rig["rig"] == name)


@pytest.fixture
def controller(lab: RunningLab) -> Iterator[ModbusTcpClient]:
    """A client that holds the lease of rig 4."""
    with closing(ModbusTcpClient("127.0.0.1", port=lab.lab.ports["rig4"], timeout=2)) as client:
        assert client.connect()
        client.read_holding_registers(4, count=4)
        assert not client.write_registers(0, [100, 0, 0, 0]).isError()
        yield client


def test_every_rig_is_served_by_one_of_the_edges(lab: RunningLab) -> None:
    for port in lab.lab.ports.values():
        with closing(ModbusTcpClient("127.0.0.1", port=port, timeout=2)) as client:
            assert client.connect()
            assert len(client.read_holding_registers(4, count=4).registers) == 4
    report = top(lab)
    assert [
        (row["service"], row["instance"], row["rigs"]) for row in report["services"] if row["service"] != "recorder"
    ] == [
        ("edge", "1", 2),
        ("edge", "2", 2),
        ("sim", "1", 4),
    ]
    assert all(rig["served"] and rig["simulated"] for rig in report["rigs"])


def test_top_shows_lease_holder_loop_and_recording(lab: RunningLab) -> None:
    def report() -> dict[str, Any] | None:
        rig = rig_of(lab, "rig4")
        return rig if rig["controller"] and rig["recording"] and rig["loop_samples"] else None

    with steady_controller(lab.lab.ports["rig4"]):
        rig = eventually(report)
        table = hilrig("top", "--once", "--config", lab.config).stdout
    assert rig["controller"].startswith("127.0.0.1:")
    assert rig["loop_p50_ms"] >= 15
    assert re.search(r"rig4\s+127\.0\.0\.1:\d+", table)
    assert "edge/2" in table


def test_prometheus_metrics_are_served(lab: RunningLab) -> None:
    port = free_ports(1)
    command = [*HILRIG, "metrics", "--config", str(lab.config), "--listen", f"127.0.0.1:{port}"]
    with Popen(command, stdout=PIPE, text=True) as process:
        assert process.stdout is not None
        assert f":{port}/metrics" in process.stdout.readline()

        def text() -> str:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
                return str(answer.read().decode())

        try:
            # Each service reports once per second: simulation, two edges and two recorders.
            eventually(lambda: text().count("hilrig_up{") == 5, every_s=0.2)
            assert 'hilrig_rig_served{lab="lab",rig="rig4"} 1' in text()
        finally:
            process.terminate()
        assert process.wait(LONG_TIMEOUT_S) == 0
    taken = hilrig("metrics", "--config", lab.config, "--listen", f"127.0.0.1:{lab.port}")
    assert taken.returncode == 3
    assert "choose another address with --listen" in taken.stderr


def test_rig_is_added_used_and_removed(lab: RunningLab, controller: ModbusTcpClient) -> None:
    with socket.socket() as other:
        next_port = lab.port + 4
        # If another program has the next port already, it may release it a moment later.
        with suppress(OSError):
            other.bind(("127.0.0.1", next_port))
            other.listen()
            next_port += 1
        done = hilrig("rig", "add", "guest", "--config", lab.config)
    assert done.returncode == 0, done.stderr
    port = int(done.stdout.strip().rpartition(":")[2])
    assert port >= next_port
    with closing(ModbusTcpClient("127.0.0.1", port=port, timeout=2)) as client:
        assert client.connect()
        for _ in range(20):
            assert not client.write_registers(0, [800, 0, 0, 0]).isError()
        eventually(lambda: client.read_holding_registers(4, count=1).registers[0] > 100)
        listed = json.loads(hilrig("rig", "list", "--json", "--config", lab.config).stdout)
        assert [(row["rig"], row["in_file"]) for row in listed][-1] == ("guest", False)
        held = json.loads(hilrig("lease", "guest", "--json", "--config", lab.config).stdout)
        assert held["holder"].startswith("127.0.0.1:")
        leases = json.loads(hilrig("lease", "--json", "--config", lab.config).stdout)
        assert [row["rig"] for row in leases] == ["rig1", "rig2", "rig3", "rig4", "guest"]
        assert hilrig("rig", "reset", "guest", "--config", lab.config).returncode == 0
        assert client.connected
        assert hilrig("rig", "remove", "guest", "--config", lab.config).returncode == 0
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=2)
    # The other rigs are not affected: connection and lease of rig 4 are unchanged.
    assert not controller.write_registers(0, [100, 0, 0, 0]).isError()


def test_rejected_rig_leaves_no_trace(lab: RunningLab) -> None:
    for arguments, code, text in [
        (("add", "rig1"), 2, "rig 'rig1' already exists in the lab"),
        (("add", "no name"), 2, "name: must be"),
        (("add", "late", "--port", str(lab.port)), 3, "rig 'late' was not added: edge/[12] .* can't listen on"),
        (("remove", "nobody"), 2, "unknown rig 'nobody'; this lab has rig1"),
        (("reset", "nobody"), 2, "unknown rig 'nobody'; this lab has rig1"),
    ]:
        done = hilrig("rig", *arguments, "--config", lab.config)
        assert done.returncode == code, done.stderr
        assert re.search(text, done.stderr)
    listed = json.loads(hilrig("rig", "list", "--json", "--config", lab.config).stdout)
    assert [row["rig"] for row in listed] == ["rig1", "rig2", "rig3", "rig4"]


@pytest.mark.parametrize(
    "words",
    [("lease",), ("impair",), ("rig", "reset"), ("rig", "remove"), ("record", "start"), ("live",)],
    ids=" ".join,
)
def test_unknown_rig_is_rejected_with_the_known_ones(lab: RunningLab, words: tuple[str, ...]) -> None:
    done = hilrig(*words, "rg1", "--config", lab.config)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.endswith("hilrig: error: unknown rig 'rg1'; this lab has rig1, rig2, rig3, rig4\n")


@pytest.mark.parametrize("words", [("top", "--once"), ("rig", "list"), ("lease",), ("impair",)], ids=" ".join)
def test_tables_of_a_lab_fit_80_columns(
    lab: RunningLab, controller: ModbusTcpClient, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    table = hilrig(*words, "--config", lab.config).stdout
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in table
    # No value is broken.
    assert words[0] not in ("top", "lease") or re.search(r"\brig4 +127\.0\.0\.1:\d+ ", table)


def test_live_without_a_display_is_reported_as_in_replay(lab: RunningLab, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    recording = Path(__file__).parents[1] / "data/limit-cycle.mcap"
    live, replay = hilrig("live", "--config", lab.config), hilrig("replay", recording)
    assert (live.returncode, replay.returncode) == (3, 3)
    assert live.stderr == replay.stderr
    assert "needs a display; without one use --save or --web" in live.stderr


def test_duplicate_rig_is_rejected() -> None:
    done = hilrig("sim", "--rigs", "rig1,rig1", timeout_s=LONG_TIMEOUT_S)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.endswith("hilrig: error: --rigs: duplicate rig 'rig1'\n")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("sim", "--instance", "2"), "sim/1 on .* already serves rig1, rig2, rig3 and 1 more; each rig has one sim"),
        (("edge", "--instance", "3", "--rigs", "rig3"), "edge/2 on .* already serves rig3; each rig has one edge"),
        (
            ("edge", "--instance", "2", "--rigs", "rig3"),
            "edge/2 on .* has the same instance name; choose another --instance",
        ),
    ],
)
def test_second_service_of_a_rig_does_not_start(lab: RunningLab, arguments: tuple[str, ...], reason: str) -> None:
    done = hilrig(*arguments, "--config", lab.config)
    assert done.returncode == 3
    assert re.search(reason, done.stderr)


def test_failed_edge_does_not_affect_rigs_of_the_other(lab: RunningLab, controller: ModbusTcpClient) -> None:
    first = next(
        pid
        for pid in lab.service_pids()
        if b"rig1,rig2" in Path(f"/proc/{pid}/cmdline").read_bytes() and _is(pid, "edge")
    )
    os.kill(first, signal.SIGKILL)
    eventually(lambda: "edge restarted" in lab.output())
    assert not controller.write_registers(0, [100, 0, 0, 0]).isError()

    def back() -> bool:
        with closing(ModbusTcpClient("127.0.0.1", port=lab.port, timeout=1)) as client:
            return client.connect() and not client.read_holding_registers(4, count=4).isError()

    eventually(back, every_s=0.1)


def test_log_has_one_json_object_per_line(lab: RunningLab) -> None:
    lines = lab.output().splitlines()
    assert lines
    for line in lines:
        assert {"time", "level", "service", "instance", "message"} <= set(json.loads(line))


def test_lab_that_is_not_running_is_reported(tmp_path: Path) -> None:
    config = write_lab(tmp_path)
    for command in (("top", "--json"), ("rig", "list")):
        done = hilrig(*command, "--config", config)
        assert done.returncode == 3
        assert "no service of lab 'lab' found: is it running" in done.stderr


def test_more_processes_than_rigs_are_rejected(tmp_path: Path) -> None:
    done = hilrig("up", "--edges", "2", "--config", write_lab(tmp_path))
    assert done.returncode == 2
    assert "--edges 2: expected 1 to 1, the number of rigs" in done.stderr


def _is(pid: int, service: str) -> bool:
    return service.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
