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
from hilrig_runtime.security.x509 import issue_server, make_authority
from hilrig_schemas import Health
from hilrig_schemas.topics import HEALTH
from support.bus_certificates import NOW, write
from support.hilrig_process import HILRIG
from support.labs import free_ports, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

LIMIT = 64
READ = bytes.fromhex("0001 0000 0006 01 03 0004 0004")


FILES = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}


def certificates(folder: Path) -> None:
    authority = make_authority("lab", NOW, 30)
    write(folder, "ca", authority)
    write(folder, "edge", issue_server(authority, ["localhost"], NOW, 30))


def read(connection: socket.socket) -> bytes:
    connection.sendall(READ)
    return connection.recv(64)


@pytest.mark.rig
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX resource limits (ulimit)")
def test_edge_at_its_file_limit_keeps_serving(tmp_path: Path) -> None:
    certificates(tmp_path)
    extra = "edge.max_connections = 200\nedge.max_connections_per_host = 200\n"
    extra += "".join(f"edge.tls.{key} = '{tmp_path / name}'\n" for key, name in FILES.items())
    config = write_lab(tmp_path, extra=f"{extra}edge.tls.first_port = {free_ports(1)}")
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
            for number in range(2 * LIMIT):
                port = lab.edge.first_port if number < LIMIT else lab.tls_ports["rig1"]
                closing.enter_context(socket.create_connection((lab.edge.host, port), timeout=LONG_TIMEOUT_S))
            eventually(lambda: "Too many open files" in log.read_text())
            before = len(reports)
            eventually(lambda: len(reports) >= before + 2)
            assert reports[-1].connections > LIMIT // 4
            assert read(first)
            # Two listening sockets retry each second.
            assert log.read_text().count("Too many open files") == 1
        finally:
            edge.send_signal(signal.SIGTERM)
            code = edge.wait(LONG_TIMEOUT_S)
    assert code == 0
    assert "Traceback" not in log.read_text()
