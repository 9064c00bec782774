"""An edge whose connections have used up the files that it may open serves those that it has, and says so."""

import os
import signal
import socket
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import load_lab
from hilrig_schemas import Health
from hilrig_schemas.topics import HEALTH
from support.labs import HILRIG, write_lab
from support.waiting import PATIENT_S, eventually

LIMIT = 64
READ = bytes.fromhex("0001 0000 0006 01 03 0004 0004")


def read(connection: socket.socket) -> bytes:
    connection.sendall(READ)
    return connection.recv(64)


@pytest.mark.rig
@pytest.mark.skipif(os.name != "posix", reason="elsewhere a process has no such limit")
def test_edge_at_its_file_limit_keeps_running(tmp_path: Path) -> None:
    config = write_lab(tmp_path, extra="edge.max_connections = 200\nedge.max_connections_per_host = 200")
    lab = load_lab(config)
    log = tmp_path / "edge.log"
    command = ["sh", "-c", f'ulimit -n {LIMIT}; exec "$@"', "sh", *HILRIG, "edge", "--config", str(config)]
    heard: list[Health] = []
    with log.open("w") as out, ExitStack() as closing:
        edge = subprocess.Popen(command, stdout=out, stderr=out, cwd=tmp_path)
        try:
            bus = closing.enter_context(ZenohBus(lab.bus, "tool"))
            # Before the files are used up: this link is one too.
            bus.subscribe(
                HEALTH.key(lab.name, "edge", "*"), lambda _, payload: heard.append(Health.FromString(payload))
            )
            eventually(lambda: heard)
            address = (lab.edge.host, lab.edge.first_port)
            first = closing.enter_context(socket.create_connection(address, timeout=PATIENT_S))
            assert read(first)
            for _ in range(LIMIT):
                closing.enter_context(socket.create_connection(address, timeout=PATIENT_S))
            eventually(lambda: "Too many open files" in log.read_text())
            before = len(heard)
            eventually(lambda: len(heard) >= before + 2)
            assert heard[-1].connections > LIMIT // 4
            assert read(first)
        finally:
            edge.send_signal(signal.SIGTERM)
            code = edge.wait(PATIENT_S)
    assert code == 0
    assert "Traceback" not in log.read_text()
