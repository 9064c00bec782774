"""Admission to the secured bus by certificate, and a complete lab on a secured bus."""

import shutil
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh
from pymodbus.client import ModbusTcpClient

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.bus.zenoh_config import router_config
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.security.x509 import Credential, issue_peer, make_authority
from support.bus_certificates import HOSTS, NOW, invalid_credentials, make_bus_folder, make_client_folder
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

INVALID = ["another authority", "expired", "not valid yet", "a controller's"]


@dataclass
class Lab:
    """Certificates of a lab, their authority, and the port of its router."""

    folder: Path
    authority: Credential
    port: int

    def config(self, folder: Path, topology: str = "router") -> BusConfig:
        tls = BusTlsConfig(folder=folder)
        router = f"tls/127.0.0.1:{self.port}"
        return BusConfig(topology=topology, router=router, first_port=self.port, tls=tls)  # type: ignore[arg-type]

    def router(self, folder: Path) -> zenoh.Session:
        return zenoh.open(router_config(self.config(folder), "lab", f"tls/127.0.0.1:{self.port}"))


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    authority = make_bus_folder(tmp_path / "bus", ["router", "sim", "edge", "recorder", "operator"])
    return Lab(tmp_path / "bus", authority, free_ports(3))


@pytest.fixture
def router(lab: Lab) -> Iterator[zenoh.Session]:
    with lab.router(lab.folder) as session:
        yield session


def test_lab_certificate_is_accepted(lab: Lab, router: zenoh.Session) -> None:
    with ZenohBus(lab.config(lab.folder), "tool") as bus:
        assert router.zid() in bus.session.info.routers_zid()


@pytest.mark.parametrize("defect", INVALID)
def test_invalid_certificate_is_refused_by_the_router(
    lab: Lab, router: zenoh.Session, tmp_path: Path, defect: str
) -> None:
    client_folder = make_client_folder(
        tmp_path / "client", lab.authority, "operator", invalid_credentials(lab.authority)[defect]
    )
    with pytest.raises(OperationError, match=r"certificates do not match: run hilrig doctor"):
        ZenohBus(lab.config(client_folder), "tool")


@pytest.mark.parametrize("link", ["tls", "tcp"])
def test_connection_without_certificate_is_refused(lab: Lab, router: zenoh.Session, link: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{link}/127.0.0.1:{lab.port}"]')
    config.insert_json5("connect/timeout_ms", "1000")
    config.insert_json5("transport/link/tls/root_ca_certificate", f'"{lab.folder}/ca.pem"')
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)


@pytest.mark.parametrize("wrong", ["authority", "name"])
def test_router_without_certificate_of_the_lab_is_refused(lab: Lab, tmp_path: Path, wrong: str) -> None:
    authority = make_authority("other", NOW, 30) if wrong == "authority" else lab.authority
    hosts = HOSTS if wrong == "authority" else ["elsewhere"]
    router_folder = make_client_folder(
        tmp_path / "other", lab.authority, "router", issue_peer(authority, "router", hosts, NOW, 30)
    )
    with lab.router(router_folder), pytest.raises(OperationError, match="certificates do not match"):
        ZenohBus(lab.config(lab.folder), "tool")


@pytest.mark.parametrize("defect", INVALID)
def test_mesh_accepts_only_certificates_of_the_lab(lab: Lab, tmp_path: Path, defect: str) -> None:
    client_folder = make_client_folder(
        tmp_path / "client", lab.authority, "operator", invalid_credentials(lab.authority)[defect]
    )
    with (
        ZenohBus(lab.config(lab.folder, "mesh"), "sim") as sim,
        # A session of a peer opens without any link and retries to connect.
        ZenohBus(lab.config(client_folder, "mesh"), "tool") as untrusted,
        ZenohBus(lab.config(lab.folder, "mesh"), "edge") as edge,
        ZenohBus(lab.config(lab.folder, "mesh"), "tool") as tool,
    ):
        eventually(lambda: {edge.session.zid(), tool.session.zid()} <= set(sim.session.info.peers_zid()))
        assert untrusted.session.zid() not in sim.session.info.peers_zid()
        assert untrusted.session.info.peers_zid() == []


@pytest.mark.parametrize("missing", ["ca.pem", "operator.pem"])
def test_missing_file_is_named(lab: Lab, missing: str) -> None:
    (lab.folder / missing).unlink()
    with pytest.raises(InputError, match=rf"bus\.tls\.folder: .*{missing} can't be read.*hilrig certs"):
        ZenohBus(lab.config(lab.folder), "tool")


def test_missing_key_of_the_service_is_named(lab: Lab) -> None:
    (lab.folder / "operator.key").unlink()
    with pytest.raises(InputError, match=r"does not contain operator\.key or viewer\.key"):
        ZenohBus(lab.config(lab.folder), "tool")


@pytest.fixture
def secured_lab(tmp_path: Path) -> Iterator[RunningLab]:
    config = write_lab(tmp_path, extra="edge.session_grace_ms = 200\nbus.tls = {folder = 'certs/bus'}")
    made = hilrig("certs", "certs", "--config", config, cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    with RunningLab(config) as running:
        yield running


def test_viewer_cannot_release_a_lease_on_the_secured_bus(secured_lab: RunningLab, tmp_path: Path) -> None:
    with ModbusTcpClient("127.0.0.1", port=secured_lab.port) as client:
        assert client.connect()
        assert not client.write_registers(0, [500, 0, 0, 0]).isError()
        eventually(lambda: client.read_holding_registers(4, count=1).registers[0] > 100)
        shown = hilrig("lease", "rig1", "-c", secured_lab.config, cwd=tmp_path)
        assert shown.returncode == 0, shown.stderr
        assert "127.0.0.1" in shown.stdout
        viewers = tmp_path / "viewer"
        (viewers / "certs/bus").mkdir(parents=True)
        for name in ("ca.pem", "viewer.pem", "viewer.key"):
            shutil.copy(tmp_path / "certs/bus" / name, viewers / "certs/bus" / name)
        refused = hilrig("lease", "rig1", "--release", "-c", secured_lab.config, cwd=viewers)
        assert refused.returncode == 3
        assert "this host has only the viewer certificate; lease requests need operator" in refused.stderr
        assert not client.write_registers(0, [0, 0, 0, 0]).isError()
    assert eventually(lambda: secured_lab.recordings)


def test_lab_listens_on_loopback_by_default(tmp_path: Path) -> None:
    with RunningLab(write_lab(tmp_path)) as running:
        addresses = {host for pid in (running.process.pid, *running.service_pids()) for host, _ in listening(pid)}
        assert addresses == {"127.0.0.1"}


def listening(pid: int) -> list[tuple[str, int]]:
    """Addresses on which a process accepts TCP connections or receives UDP packets."""
    inodes = set()
    for fd in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.add(str(fd.readlink()).removeprefix("socket:[").removesuffix("]"))
        except OSError:
            continue
    found = []
    for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == state and fields[9] in inodes:
                host, port = fields[1].split(":")
                found.append((_address(host), int(port, 16)))
    return found


def _address(text: str) -> str:
    words = [int(text[at : at + 8], 16).to_bytes(4, "little") for at in range(0, len(text), 8)]
    family = socket.AF_INET if len(words) == 1 else socket.AF_INET6
    return socket.inet_ntop(family, b"".join(words))
