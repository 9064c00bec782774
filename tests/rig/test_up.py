"""`hilrig up`: third-party controllers move the arm; services are restarted; a signal stops the lab in order."""

import os
import platform
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from hilrig_replay.io.run import open_run
from support.clients import build_c_client, mbpoll_read, mbpoll_write, require_mbpoll
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.recordings import content_of
from support.waiting import eventually

pytestmark = pytest.mark.rig


GRACE = "edge.session_grace_ms = 200"


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[RunningLab]:
    """A lab that the test stops, or whose services it kills."""
    with RunningLab(write_lab(tmp_path, extra=GRACE)) as running:
        yield running


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    """A lab for the tests that leave it as it was."""
    with RunningLab(write_lab(tmp_path_factory.mktemp("shared"), extra=GRACE)) as running:
        yield running


@contextmanager
def next_recording(lab: RunningLab) -> Iterator[list[Path]]:
    """Yield a list; after the context, it has the recording of the session within."""
    eventually(lambda: not list(lab.lab.recorder.folder.rglob("*.part")))
    known, found = set(lab.recordings), list[Path]()
    yield found
    found += eventually(lambda: [path for path in lab.recordings if path not in known])


def registers(*values: int) -> list[int]:
    """Signed values as Modbus registers."""
    return [value & 0xFFFF for value in values]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_mbpoll_moves_joint_1_and_friction_stops_it(shared: RunningLab) -> None:
    require_mbpoll()
    lab = shared
    start = mbpoll_read(lab.port, register=5, count=4)
    assert start == [0, 0, 0, 0] or start[:2] == [0, 0]
    mbpoll_write(lab.port, register=1, value=1500)
    turned = eventually(lambda: (now := mbpoll_read(lab.port, 5, 4))[0] > start[0] + 200 and now)
    mbpoll_write(lab.port, register=1, value=0)

    def is_at_rest() -> bool:
        first = mbpoll_read(lab.port, 5, 4)[0]
        time.sleep(0.1)  # the arm would move between the two readings
        return mbpoll_read(lab.port, 5, 4)[0] == first >= turned[0]

    eventually(is_at_rest)


def test_mbpoll_switches_the_magnet(shared: RunningLab) -> None:
    require_mbpoll()
    lab = shared
    with next_recording(lab) as recordings:
        mbpoll_write(lab.port, register=1, value=1, kind="coil")
        assert mbpoll_read(lab.port, 1, 1, kind="coil") == [1]
        mbpoll_write(lab.port, register=1, value=0, kind="coil")
        assert mbpoll_read(lab.port, 1, 1, kind="coil") == [0]
    content = content_of(recordings[0])
    for secret in (lab.config.parent, lab.config.parent.name, Path.home(), platform.node()):
        assert str(secret).encode() not in content, f"the recording reveals {secret}"
    magnet = open_run(recordings[0]).states["magnet"]
    assert magnet.any()
    assert not magnet[-1]


def test_c_controller_on_libmodbus_closes_the_loop(shared: RunningLab) -> None:
    client = build_c_client()
    with next_recording(shared) as recordings:
        output = subprocess.run(
            [client, "127.0.0.1", str(shared.port), "2", "5"], check=True, capture_output=True, text=True, timeout=30
        ).stdout
    assert '"cycles"' in output
    report = hilrig("latency", recordings[0], "--json")
    assert report.returncode in (0, 1), report.stderr
    assert '"samples"' in report.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_the_lab_in_order(lab: RunningLab, number: signal.Signals) -> None:
    with ModbusTcpClient("127.0.0.1", port=lab.port) as client:
        client.write_registers(0, registers(500, 0, -4905, 0))
        eventually(lambda: client.read_holding_registers(4, count=4).registers[0] > 0)
        children = lab.service_pids()
        assert len(children) == 3
        assert lab.stop(number) == 0, lab.output()
    assert "timed out" not in lab.output()
    assert not any(alive(pid) for pid in children)
    (recording,) = lab.recordings
    run = open_run(recording)
    assert len(run.states) > 0
    assert not list(lab.lab.recorder.folder.rglob("*.part"))


def test_killed_services_are_restarted(lab: RunningLab) -> None:
    for name in ("recorder", "edge"):
        before = lab.service_pid(name)
        os.kill(before, signal.SIGKILL)

        def is_restarted(name: str = name, before: int = before) -> bool:
            try:
                return lab.service_pid(name) != before
            except LookupError:
                return False

        eventually(is_restarted)

    def responds() -> bool:
        with ModbusTcpClient("127.0.0.1", port=lab.port, timeout=1, retries=0) as client:
            return client.connected and not client.read_holding_registers(4, count=4).isError()

    eventually(responds, every_s=0.1)
    with ModbusTcpClient("127.0.0.1", port=lab.port) as client:

        def angle(torque: int) -> int:
            assert not client.write_registers(0, registers(torque, 0, -4905, 0)).isError()
            return int(client.read_holding_registers(4, count=4).registers[0])

        eventually(lambda: angle(1000) > 500, every_s=0.02)
        os.kill(lab.service_pid("sim"), signal.SIGKILL)
        # The new simulation starts at its start pose and obeys commands.
        eventually(lambda: angle(1000) < 100, every_s=0.02)
        eventually(lambda: angle(1000) > 500, every_s=0.02)
    for name in ("recorder", "edge", "sim"):
        assert f"{name} was killed by signal 9; restarting it" in lab.output()
        assert f"{name} restarted" in lab.output()
    assert lab.stop() == 0


def test_services_stop_when_up_is_killed(lab: RunningLab) -> None:
    children = lab.service_pids()
    lab.process.kill()
    lab.process.wait()
    eventually(lambda: not any(alive(pid) for pid in children))


def test_modbus_port_in_use_is_reported_in_one_line(shared: RunningLab, tmp_path: Path) -> None:
    second = tmp_path / "second.toml"
    text = shared.config.read_text().replace(
        f"first_port = {shared.lab.bus.first_port}", f"first_port = {free_ports(3)}"
    )
    second.write_text(text)
    done = hilrig("up", "--config", second, timeout_s=60)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if f"127.0.0.1:{shared.port}" in line]
    assert "rig1" in line
    assert "port" in line


def test_bus_ports_in_use_are_reported_in_one_line(shared: RunningLab) -> None:
    done = hilrig("up", "--config", shared.config, timeout_s=60)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "is another hilrig running here?" in done.stderr
