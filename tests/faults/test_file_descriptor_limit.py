"""An edge at its limit of open files keeps serving the existing connections and logs the limit."""

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
from support.waiting import LONG_TIMEOUT_S, eventually

LIMIT = 64
READ = bytes.fromhex("0001 0000 0006 01 03 0004 0004")


def read(connection: socket.socket) -> bytes:
    connection.sendall(READ)
    return connection.recv(64)


@pytest.mark.rig
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX resource limits (ulimit)")
def test_edge_at_its_file_limit_keeps_serving(tmp_path: Path) -> None:
    config = write_lab(tmp_path, extra="edge.max_connections = 200\nedge.max_connections_per_host = 200")
    lab = load_lab(config)
    log = tmp_path / "edge.log"
    command = ["sh", "-c", f'ulimit -n {LIMIT}; exec "$@"', "sh", *HILRIG, "edge", "--config", str(config)]
    reports: list[Health] = []
    with log.open("w") as out, ExitStack() as closing:
        edge = subprocess.Popen(command, stdout=out, stderr=out, cwd=tmp_path)
        try:
            bus = closing.enter_context(ZenohBus(lab.bus, "tool"))
            # Subscribe before the limit is reached: the link needs a file descriptor too.
            bus.subscribe(
                HEALTH.key(lab.name, "edge", "*"), lambda _, payload: reports.append(Health.FromString(payload))
            )
            eventually(lambda: reports)
            address = (lab.edge.host, lab.edge.first_port)
            first = closing.enter_context(socket.create_connection(address, timeout=LONG_TIMEOUT_S))
            assert read(first)
            for _ in range(LIMIT):
                closing.enter_context(socket.create_connection(address, timeout=LONG_TIMEOUT_S))
            eventually(lambda: "Too many open files" in log.read_text())
            before = len(reports)
            eventually(lambda: len(reports) >= before + 2)
            assert reports[-1].connections > LIMIT // 4
            assert read(first)
        finally:
            edge.send_signal(signal.SIGTERM)
            code = edge.wait(LONG_TIMEOUT_S)
    assert code == 0
    assert "Traceback" not in log.read_text()
