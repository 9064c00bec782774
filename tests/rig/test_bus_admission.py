"""Who is let in on the secured bus at all, and a whole lab that runs on it."""

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
from support.bus_certificates import HOSTS, NOW, bad_identities, folder_of_one, make_bus_folder
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

BAD = ["another authority", "expired", "not valid yet", "a controller's"]


@dataclass
class Lab:
    """A lab's certificates, and somebody's own."""

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


def test_who_has_a_certificate_of_the_lab_is_let_in(lab: Lab, router: zenoh.Session) -> None:
    with ZenohBus(lab.config(lab.folder), "tool") as bus:
        assert router.zid() in bus.session.info.routers_zid()


@pytest.mark.parametrize("what", BAD)
def test_a_certificate_that_is_no_good_is_not_let_in(
    lab: Lab, router: zenoh.Session, tmp_path: Path, what: str
) -> None:
    mine = folder_of_one(tmp_path / "mine", lab.authority, "operator", bad_identities(lab.authority)[what])
    with pytest.raises(OperationError, match=r"do not trust each other: hilrig doctor"):
        ZenohBus(lab.config(mine), "tool")


@pytest.mark.parametrize("link", ["tls", "tcp"])
def test_without_a_certificate_nobody_is_let_in(lab: Lab, router: zenoh.Session, link: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{link}/127.0.0.1:{lab.port}"]')
    config.insert_json5("connect/timeout_ms", "1000")
    config.insert_json5("transport/link/tls/root_ca_certificate", f'"{lab.folder}/ca.pem"')
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)


@pytest.mark.parametrize("wrong", ["authority", "name"])
def test_a_router_that_is_not_the_labs_is_not_believed(lab: Lab, tmp_path: Path, wrong: str) -> None:
    authority = make_authority("stranger", NOW, 30) if wrong == "authority" else lab.authority
    hosts = HOSTS if wrong == "authority" else ["elsewhere"]
    theirs = folder_of_one(
        tmp_path / "theirs", lab.authority, "router", issue_peer(authority, "router", hosts, NOW, 30)
    )
    with lab.router(theirs), pytest.raises(OperationError, match="do not trust each other"):
        ZenohBus(lab.config(lab.folder), "tool")


@pytest.mark.parametrize("what", BAD)
def test_a_mesh_lets_in_its_own_only(lab: Lab, tmp_path: Path, what: str) -> None:
    mine = folder_of_one(tmp_path / "mine", lab.authority, "operator", bad_identities(lab.authority)[what])
    with (
        ZenohBus(lab.config(lab.folder, "mesh"), "sim") as sim,
        # A peer's session opens whoever it can reach; it tries again and again.
        ZenohBus(lab.config(mine, "mesh"), "tool") as stranger,
        ZenohBus(lab.config(lab.folder, "mesh"), "edge") as edge,
        ZenohBus(lab.config(lab.folder, "mesh"), "tool") as tool,
    ):
        for service in (edge, tool):
            eventually(lambda service=service: service.session.zid() in sim.session.info.peers_zid())
        assert stranger.session.zid() not in sim.session.info.peers_zid()
        assert stranger.session.info.peers_zid() == []


@pytest.mark.parametrize("missing", ["ca.pem", "operator.pem"])
def test_a_file_that_is_missing_is_named(lab: Lab, missing: str) -> None:
    (lab.folder / missing).unlink()
    with pytest.raises(InputError, match=rf"bus\.tls\.folder: .*{missing} can't be read.*hilrig certs"):
        ZenohBus(lab.config(lab.folder), "tool")


def test_a_host_without_a_key_for_the_service_is_told_which_it_needs(lab: Lab) -> None:
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


def test_a_lab_runs_on_a_secured_bus_and_a_viewer_may_not_take_its_rig(secured_lab: RunningLab, tmp_path: Path) -> None:
    with ModbusTcpClient("127.0.0.1", port=secured_lab.port) as client:
        assert client.connect()
        assert not client.write_registers(0, [500, 0, 0, 0]).isError()
        eventually(lambda: client.read_holding_registers(4, count=1).registers[0] > 100)
        asked = hilrig("lease", "rig1", "-c", secured_lab.config, cwd=tmp_path)
        assert asked.returncode == 0, asked.stderr
        assert "127.0.0.1" in asked.stdout
        viewers = tmp_path / "viewer"
        (viewers / "certs/bus").mkdir(parents=True)
        for name in ("ca.pem", "viewer.pem", "viewer.key"):
            shutil.copy(tmp_path / "certs/bus" / name, viewers / "certs/bus" / name)
        refused = hilrig("lease", "rig1", "--release", "-c", secured_lab.config, cwd=viewers)
        assert refused.returncode == 3
        assert "no edge answers" in refused.stderr
        assert not client.write_registers(0, [0, 0, 0, 0]).isError()
    assert eventually(lambda: secured_lab.recordings)


def test_a_lab_listens_on_loopback_only_unless_told_otherwise(tmp_path: Path) -> None:
    with RunningLab(write_lab(tmp_path)) as running:
        addresses = {host for pid in (running.process.pid, *running.service_pids()) for host, _ in listening(pid)}
        assert addresses == {"127.0.0.1"}


def listening(pid: int) -> list[tuple[str, int]]:
    """Addresses on which a process waits for TCP connections, or receives UDP."""
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
