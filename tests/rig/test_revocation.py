"""`[edge.tls.clients]`, SIGHUP and `hilrig certs --revoke`, with the certificates of `hilrig certs` and a real lab."""

import json
import signal
import socket
import ssl
import struct
from contextlib import ExitStack
from pathlib import Path

import pytest

from hilrig_replay.io.run import open_run
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
WRITE = struct.pack(">HHHBBHH", 2, 0, 6, 1, 6, 0, 100)
REFUSED_AS_READER, REFUSED_BUSY, WRITTEN = b"\x86\x01", b"\x86\x06", WRITE[7:]


class Controller:
    """A connection to the TLS port of the first rig; without a name, to the plain port."""

    def __init__(self, lab: RunningLab, certs: Path, name: str) -> None:
        port = lab.lab.tls_ports["rig1"] if name else lab.port
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5)
        if name:
            context = ssl.create_default_context(cafile=certs / "ca.pem")
            context.load_cert_chain(certs / f"{name}.pem", certs / f"{name}.key")
            self.socket = context.wrap_socket(self.socket, server_hostname="localhost")

    def ask(self, request: bytes) -> bytes:
        """Return the PDU of the response; empty: the connection is closed."""
        try:
            self.socket.sendall(request)
            return self.socket.recv(300)[7:]
        except OSError:
            return b""


def revoke(config: Path, name: str) -> tuple[int, str]:
    done = hilrig("certs", "--revoke", name, "--config", config, "--json")
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout + done.stderr


def test_certificate_is_permitted_and_revoked_in_use(tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    assert hilrig("certs", certs, "--client", "alice=operator", "--client", "bob=operator").returncode == 0
    files = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}
    extra = "\n".join(f"edge.tls.{key} = '{certs / file}'" for key, file in files.items())
    extra += f'\nedge.tls.first_port = {free_ports(1)}\nedge.tls.clients.alice = ["rig1"]\nedge.session_grace_ms = 200'
    config = write_lab(tmp_path, extra=extra)
    listed = config.read_text()
    both = listed.replace("tls.clients.alice", 'tls.clients.bob = ["*"]\ntls.clients.alice')
    only_bob = listed.replace("tls.clients.alice", "tls.clients.bob")
    elsewhere = tmp_path / "elsewhere.toml"
    elsewhere.write_text(only_bob)
    with RunningLab(config) as lab, ExitStack() as closing:

        def connect(name: str) -> Controller:
            controller = Controller(lab, certs, name)
            closing.callback(controller.socket.close)
            return controller

        alice, bob, plain = map(connect, ("alice", "bob", ""))
        for reader in (bob, plain):
            assert reader.ask(READ)[:2] == b"\x03\x08"
            assert reader.ask(WRITE) == REFUSED_AS_READER
        assert alice.ask(WRITE) == WRITTEN

        config.write_text(both)
        lab.process.send_signal(signal.SIGHUP)
        eventually(lambda: bob.ask(WRITE) == REFUSED_BUSY)
        config.write_text(both.replace('["rig1"]', '["rig9"]'))
        lab.process.send_signal(signal.SIGHUP)
        eventually(lambda: "previous one stays in force: " in lab.output())
        assert "edge.tls.clients.alice: unknown rig 'rig9'" in lab.output()
        assert alice.ask(WRITE) == WRITTEN

        config.write_text(both)
        code, text = revoke(config, "alice")
        assert (code, "still lists alice: remove it from [edge.tls.clients] first" in text) == (3, True)
        code, text = revoke(elsewhere, "alice")
        assert (code, "edge/1 on" in text, f"{config} on" in text) == (3, True, True), text
        assert alice.ask(WRITE) == WRITTEN

        config.write_text(only_bob)
        code, text = revoke(config, "alice")
        assert code == 0, text
        assert "connections closed: 1" in json.loads(text)["edges"].popitem()[1]
        assert alice.ask(READ) == b""
        assert connect("alice").ask(WRITE) == REFUSED_AS_READER
        eventually(lambda: bob.ask(WRITE) == WRITTEN)
        assert lab.process.poll() is None
    assert {open_run(path).certificate for path in lab.recordings} == {"alice", "bob"}
    listed_runs = hilrig("runs", "--config", config, "--controller", "ali", "--no-loop", "--json")
    assert [run["certificate"] for run in json.loads(listed_runs.stdout)["runs"]] == ["alice"]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("", "no [edge.tls]"),
        ("[edge.tls]\ncertificate = 'e'\nkey = 'e'\nauthority = 'e'\n", "has no [edge.tls.clients], so every"),
        ("[edge.tls]\ncertificate = 'e'\nkey = 'e'\nauthority = 'e'\nclients = {}\n", "no edge answers for rig1"),
    ],
)
def test_revocation_that_has_no_effect_fails(tmp_path: Path, table: str, message: str) -> None:
    config = write_lab(tmp_path)
    config.write_text(config.read_text() + table)
    code, text = revoke(config, "alice")
    assert code != 0
    assert message in text


@pytest.mark.parametrize("name", ["", "*", "../alice"])
def test_revocation_of_an_invalid_name_is_refused(tmp_path: Path, name: str) -> None:
    config = write_lab(tmp_path)
    config.write_text(config.read_text() + "[edge.tls]\ncertificate = 'e'\nkey = 'e'\nauthority = 'e'\nclients = {}\n")
    code, text = revoke(config, name)
    assert (code, f"{name!r} must be the common name" in text) == (2, True), text
