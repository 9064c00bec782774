"""compose.yaml: its services run as real processes, each on its own host with its own certificate only."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from hilrig_runtime.config.lab import load_lab
from support.labs import hilrig
from support.namespaces import Network, require_namespaces
from support.waiting import LONG_TIMEOUT_S, eventually

ROOT = Path(__file__).parents[2]
LAB_FILE = ROOT / "compose/lab.toml"
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
EDGES = {"east": "rig1,rig2", "west": "rig3,rig4"}
CERTIFICATES = {"console": "viewer"}
"""Services whose certificate has another name: the console uses the read-only certificate `viewer`."""
HILRIG = str(Path(sys.executable).with_name("hilrig"))

CONTROLLER = """
import sys, time
from pymodbus.client import ModbusTcpClient

client = ModbusTcpClient(sys.argv[1], port=int(sys.argv[2]), timeout=2)
assert client.connect(), "no connection"
for _ in range(60):
    before = client.read_holding_registers(4, count=4).registers
    assert not client.write_registers(0, [500, 0, 0, 0]).isError()
    time.sleep(0.02)
after = client.read_holding_registers(4, count=4).registers
print(before[0], after[0])
client.close()
"""

VIEWER = """
import json, sys, urllib.error, urllib.request

address, password = sys.argv[1:]
try:
    urllib.request.urlopen(address, timeout=10)
except urllib.error.HTTPError as error:
    print(error.code)
known = urllib.request.HTTPPasswordMgrWithDefaultRealm()
known.add_password(None, address, "teacher", password)
opener = urllib.request.build_opener(urllib.request.HTTPBasicAuthHandler(known))
with opener.open(address, timeout=20) as stream:
    for line in stream:
        lab = json.loads(line[6:]) if line.startswith(b'data: {"lab"') else {"rigs": []}
        seen = [rig["rig"] for rig in lab["rigs"] if rig["served"] and rig["simulated"] and rig["address"]]
        if len(seen) == 4:
            print(*sorted(seen))
            break
"""

UNTRUSTED_CLIENT = """
import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", '["tls/router:7447"]')
config.insert_json5("connect/timeout_ms", "2000")
config.insert_json5("transport/link/tls/root_ca_certificate", '"%s"')
try:
    zenoh.open(config).close()
except zenoh.ZError:
    print("connection refused")
"""


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_is_confined_and_has_a_health_check(name: str) -> None:
    service = SERVICES[name]
    assert service["user"] == "10001:10001"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["restart"] == "unless-stopped"
    assert {"mem_limit", "pids_limit", "logging"} <= set(service)
    kind = "edge" if name in EDGES else name
    assert service["command"][:2] == ["hilrig", kind]
    assert service["build"]["args"]["PARTS"] == kind
    check = service["healthcheck"]["test"]
    expected = ["console", "--check"] if kind == "console" else ["doctor", "--service", kind]
    assert check[: 2 + len(expected)] == ["CMD", "hilrig", *expected]


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_mounts_only_its_own_certificate(name: str) -> None:
    mounted = {source: (target, mode) for source, target, *mode in (v.split(":") for v in SERVICES[name]["volumes"])}
    certificates = {source for source in mounted if source.startswith("./certs/")}
    own = CERTIFICATES.get(name, name)
    assert certificates == {f"./certs/bus/{file}" for file in ("ca.pem", f"{own}.pem", f"{own}.key")}
    assert {source for source in mounted if mounted[source][1] != ["ro"]} <= {"./recordings"}
    assert ("./recordings" in mounted) == (name in ("recorder", "console"))
    assert mounted.get("./recordings", ("", []))[1] == (["ro"] if name == "console" else [])


def test_lab_file_and_compose_file_agree() -> None:
    lab = load_lab(LAB_FILE)
    assert lab.bus.router == "tls/router:7447"
    assert SERVICES["router"]["command"][-2:] == ["--listen", "tls/0.0.0.0:7447"]
    assert lab.bus.tls is not None
    assert {edge: ",".join(rigs) for edge, rigs in lab.bus.tls.edges.items()} == EDGES
    for edge, rigs in EDGES.items():
        assert SERVICES[edge]["command"][-4:] == ["--instance", edge, "--rigs", rigs]
        ports = [lab.ports[rig] for rig in rigs.split(",")]
        span = f"{ports[0]}-{ports[-1]}"
        # By default the ports are published on loopback only.
        assert SERVICES[edge]["ports"] == [f"127.0.0.1:{span}:{span}"]
    assert f"./recordings:{lab.recorder.folder}" in SERVICES["recorder"]["volumes"]
    assert COMPOSE["networks"]["bus"]["internal"] is True
    assert SERVICES["console"]["ports"] == ["127.0.0.1:8050:8050"]
    networks = {"east": ["bus", "controllers"], "west": ["bus", "controllers"], "console": ["bus", "browsers"]}
    assert all(service["networks"] == networks.get(name, ["bus"]) for name, service in SERVICES.items())


def test_image_installs_the_parts_named_in_compose() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    for folder in ("schemas", "runtime", "services", "tools", "examples"):
        assert f"COPY {folder} {folder}" in dockerfile
    assert "\nUSER 10001:10001\n" in dockerfile
    assert ":latest" not in dockerfile
    pyproject = (ROOT / "pyproject.toml").read_text()
    for service in SERVICES.values():
        assert f"\n{service['build']['args']['PARTS']} = [" in pyproject


def test_compose_implementation_parses_the_file() -> None:
    command = [*compose_command(), "--file", "compose.yaml", "config"]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    understood = yaml.safe_load(done.stdout)
    assert set(understood["services"]) == set(SERVICES)
    assert published(understood["services"]["east"]) == ["127.0.0.1:5020:5020/tcp", "127.0.0.1:5021:5021/tcp"]
    assert published(understood["services"]["console"]) == ["127.0.0.1:8050:8050/tcp"]
    assert all(service["read_only"] for service in understood["services"].values())


def compose_command() -> list[str]:
    """Command of the installed compose implementation: `docker-compose` or `docker compose`."""
    for command in (["docker-compose"], ["docker", "compose"]):
        if shutil.which(command[0]) is None:
            continue
        if subprocess.run([*command, "version"], check=False, capture_output=True, timeout=60).returncode == 0:
            return command
    pytest.skip("needs docker-compose (Debian package docker-compose), or docker with the compose plugin")


def published(service: dict[str, Any]) -> list[str]:
    """Ports of a service as compose 1 prints them; compose 2 prints each as a table."""
    return [
        port if isinstance(port, str) else "{host_ip}:{published}:{target}/{protocol}".format_map(port)
        for port in service["ports"]
    ]


@dataclass
class Containers:
    """The services of compose.yaml, each on its own host with only the files that compose.yaml mounts."""

    network: Network
    folder: Path
    processes: dict[str, subprocess.Popen[Any]]

    def start(self, name: str) -> None:
        with (self.folder / f"{name}.log").open("a") as log:
            self.processes[name] = self.network.popen(
                name, self.local_command(name, SERVICES[name]["command"]), stdout=log
            )

    def local_command(self, name: str, command: list[str]) -> list[str]:
        """Command of a container, with the paths of its mounts in this test."""
        inside = {"hilrig": HILRIG, "/etc/hilrig/lab.toml": str(self.folder / name / "lab.toml")}
        return [inside.get(argument, argument) for argument in command]

    def mount(self, name: str, certificates: Path) -> None:
        own = self.folder / name
        own.mkdir()
        for volume in SERVICES[name]["volumes"]:
            source, target = volume.split(":")[:2]
            if source.startswith("./certs/bus/"):
                shutil.copy(certificates / Path(source).name, own / Path(target).name)
        text = LAB_FILE.read_text().replace('"/certs"', f'"{own}"')
        (own / "lab.toml").write_text(text.replace('"/recordings"', f'"{self.folder / "recordings"}"'))

    def is_healthy(self, name: str) -> bool:
        """Whether the health check of a container succeeds."""
        command = self.local_command(name, SERVICES[name]["healthcheck"]["test"][1:])
        return self.network.call(name, command) == 0


@pytest.fixture
def containers(tmp_path: Path) -> Iterator[Containers]:
    require_namespaces()
    made = hilrig("certs", tmp_path / "certs", "--config", LAB_FILE)
    assert made.returncode == 0, made.stderr
    with Network([*SERVICES, "controller"]) as network:
        running = Containers(network, tmp_path, {})
        # The router starts last: each service waits for it.
        for name in reversed(SERVICES):
            running.mount(name, tmp_path / "certs/bus")
            running.start(name)
        yield running


@pytest.mark.hosts
@pytest.mark.timeout(300)
def test_services_connect_by_name_and_controllers_move_arms(containers: Containers) -> None:
    network, folder = containers.network, containers.folder

    def drive(edge: str, port: int) -> tuple[int, int] | None:
        command = [sys.executable, "-c", CONTROLLER, edge, str(port)]
        try:
            output = network.run("controller", command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        except subprocess.CalledProcessError:
            return None
        before, after = map(int, output.stdout.split())
        return (before, after) if after != before else None

    for edge, port in (("east", 5020), ("west", 5023)):
        before, after = eventually(lambda edge=edge, port=port: drive(edge, port), timeout_s=90, every_s=0.2)
        assert after > before
    assert all(eventually(lambda name=name: containers.is_healthy(name)) for name in SERVICES)

    password = re.search(r"password: (\S+)", (folder / "console.log").read_text())
    assert password is not None
    viewer = [sys.executable, "-c", VIEWER, f"http://{network.address('console')}:8050/live", password[1]]
    seen = network.run("controller", viewer, stdout=subprocess.PIPE, text=True).stdout.split()
    assert seen == ["401", *sorted(rig.name for rig in load_lab(LAB_FILE).rigs)]

    untrusted_client = [sys.executable, "-c", UNTRUSTED_CLIENT % (folder / "router/ca.pem")]
    assert (
        network.run("controller", untrusted_client, stdout=subprocess.PIPE, text=True).stdout == "connection refused\n"
    )

    containers.processes["sim"].kill()
    containers.processes["sim"].wait()
    assert not containers.is_healthy("sim")
    containers.start("sim")
    assert eventually(lambda: containers.is_healthy("sim"))

    for name in ("console", "east", "west", "sim", "recorder", "router"):
        process = containers.processes[name]
        assert process.poll() is None, f"{name} exited unexpectedly"
        process.terminate()
        assert process.wait(LONG_TIMEOUT_S) == 0, f"{name} did not exit with code 0 on SIGTERM"
    assert {path.parent.name for path in (folder / "recordings").rglob("*.mcap")} == {"rig1", "rig4"}
    assert not list((folder / "recordings").rglob("*.part"))
