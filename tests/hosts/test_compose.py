"""The compose files: their services run as real processes, each on its own host with only the files that it mounts."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from hilrig_cli import extras
from hilrig_runtime.config.lab import load_lab
from support.labs import hilrig
from support.namespaces import Network, require_namespaces
from support.waiting import LONG_TIMEOUT_S, eventually

ROOT = Path(__file__).parents[2]
FILES = ("compose.yaml", "compose/secure.yaml")
PLAIN, COMPOSE = (yaml.safe_load((ROOT / file).read_text()) for file in FILES)
LAB_FILE = ROOT / "compose/secure.toml"
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
RUNNING = {name: service for name, service in PLAIN["services"].items() if name not in ("setup", "demo")}
USER = "10001"
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


@pytest.mark.parametrize(
    ("name", "service"), [*SERVICES.items(), *RUNNING.items()], ids=[*SERVICES, *(f"plain {name}" for name in RUNNING)]
)
def test_every_service_is_confined_and_has_a_health_check(name: str, service: dict[str, Any]) -> None:
    assert service["user"] == "10001:10001"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["restart"] == "unless-stopped"
    assert {"mem_limit", "pids_limit", "logging"} <= set(service)
    assert service["image"] == SERVICES["router"]["image"]
    kind = "edge" if name in EDGES else name
    assert service["command"][:2] == ["hilrig", kind]
    check = service["healthcheck"]["test"]
    expected = ["console", "--check"] if kind == "console" else ["doctor", "--service", kind]
    assert check[: 2 + len(expected)] == ["CMD", "hilrig", *expected]


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_mounts_only_its_own_certificate(name: str) -> None:
    mounted = {source: (target, mode) for source, target, *mode in (v.split(":") for v in SERVICES[name]["volumes"])}
    certificates = {source for source in mounted if source.startswith("../certs/")}
    own = CERTIFICATES.get(name, name)
    assert certificates == {f"../certs/bus/{file}" for file in ("ca.pem", f"{own}.pem", f"{own}.key")}
    assert {source for source in mounted if mounted[source][1] != ["ro"]} <= {"../recordings"}
    assert ("../recordings" in mounted) == (name in ("recorder", "console"))
    assert mounted.get("../recordings", ("", []))[1] == (["ro"] if name == "console" else [])


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
    assert f"../recordings:{lab.recorder.folder}" in SERVICES["recorder"]["volumes"]
    assert COMPOSE["networks"]["bus"]["internal"] is True
    assert SERVICES["console"]["ports"] == ["127.0.0.1:8050:8050"]
    networks = {"east": ["bus", "controllers"], "west": ["bus", "controllers"], "console": ["bus", "browsers"]}
    assert all(service["networks"] == networks.get(name, ["bus"]) for name, service in SERVICES.items())


def test_plain_lab_file_and_compose_file_agree() -> None:
    lab = load_lab(ROOT / "compose/lab.toml")
    services = PLAIN["services"]
    assert lab.bus.router == "tls/router:7447"
    assert services["router"]["command"][-2:] == ["--listen", "tls/0.0.0.0:7447"]
    assert services["edge"]["ports"] == [f"127.0.0.1:{port}:{port}" for port in lab.ports.values()]
    assert f"./recordings:{lab.recorder.folder}" in services["recorder"]["volumes"]
    assert services["demo"]["command"][-2:] == ["edge", str(lab.recorder.folder)]
    assert services["setup"]["command"][-2:] == ["/certs", str(lab.recorder.folder)]
    assert PLAIN["networks"]["bus"]["internal"] is True
    waits = {"setup": {"condition": "service_completed_successfully"}}
    assert all(service["depends_on"] == waits for service in RUNNING.values())
    assert services["demo"]["profiles"] == ["demo"]
    # One image, built once; only `setup` is root, with the rights of a change of owner.
    assert [name for name, service in services.items() if "build" in service] == ["setup"]
    assert [name for name, service in services.items() if service["user"] != "10001:10001"] == ["setup"]
    assert services["setup"]["cap_add"] == ["CHOWN", "DAC_OVERRIDE", "FOWNER"]


def test_image_installs_the_extras_of_its_services() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    for folder in ("schemas", "runtime", "services", "tools", "examples", "compose", "exercises"):
        assert f"COPY {folder} {folder}" in dockerfile
    assert "\nUSER 10001:10001\n" in dockerfile
    assert ":latest" not in dockerfile
    (parts,) = re.findall(r"^ARG PARTS=(\S+)$", dockerfile, re.MULTILINE)
    installed = {command for extra in ("", *parts.split(",")) for command in extras.COMMANDS[extra].split()}
    used = {service["command"][1] for service in [*SERVICES.values(), *RUNNING.values()]}
    scripts = "".join((ROOT / f"compose/{name}.sh").read_text() for name in ("setup", "demo"))
    used |= set(re.findall(r"\bhilrig (\w+) ", scripts)) - {"latency", "report"}
    assert used <= installed


@pytest.mark.parametrize("file", FILES)
def test_compose_implementation_parses_the_file(file: str) -> None:
    command = [*compose_command(), "--file", file, "config"]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    understood = yaml.safe_load(done.stdout)
    if file == FILES[1]:
        assert set(understood["services"]) == set(SERVICES)
        assert published(understood["services"]["east"]) == ["127.0.0.1:5020:5020/tcp", "127.0.0.1:5021:5021/tcp"]
    else:
        assert {"setup", *RUNNING} <= set(understood["services"])
        assert published(understood["services"]["edge"]) == ["127.0.0.1:5020:5020/tcp"]
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
    """The services of compose/secure.yaml, each on its own host with only the files that compose.yaml mounts."""

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
            if source.startswith("../certs/bus/"):
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
@pytest.mark.skipif("HILRIG_LONG" not in os.environ, reason="takes 30 s: make test-long")
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
        before, after = eventually(partial(drive, edge, port), timeout_s=90, every_s=0.2)
        assert after > before
    eventually(lambda: all(containers.is_healthy(name) for name in SERVICES))

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


@dataclass
class Volumes:
    """The volumes of compose.yaml in a folder that every user can enter."""

    folder: Path

    def local(self, name: str, service: dict[str, Any]) -> list[str]:
        """Command of a container, with the paths of its mounts in this test."""
        configuration = self.folder / "etc"
        if not configuration.exists():
            shutil.copytree(ROOT / "compose", configuration)
            lab = configuration / "lab.toml"
            lab.write_text(self._replaced(lab.read_text()))
            for volume in ("certs", "recordings"):
                (self.folder / volume).mkdir(exist_ok=True)
        command = [self._replaced(argument) for argument in service["command"]]
        assert command[0] in ("hilrig", "sh"), name
        return [HILRIG, *command[1:]] if command[0] == "hilrig" else command

    def _replaced(self, text: str) -> str:
        for inside, outside in (("/etc/hilrig", "etc"), ("/certs", "certs"), ("/recordings", "recordings")):
            text = text.replace(inside, str(self.folder / outside))
        return text


@pytest.fixture
def volumes() -> Iterator[Volumes]:
    with tempfile.TemporaryDirectory(prefix="hilrig-compose-") as folder:
        Path(folder).chmod(0o755)
        yield Volumes(Path(folder))


def environment() -> dict[str, str]:
    """Environment in which `hilrig` and `python` are those of this test, as in the image."""
    return {**os.environ, "PATH": f"{Path(HILRIG).parent}:{os.environ['PATH']}", "MPLCONFIGDIR": "/tmp"}


def test_setup_runs_on_empty_folders_as_the_user_of_services(volumes: Volumes) -> None:
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("needs root and setpriv (Debian package util-linux) to become another user")
    as_user = ["setpriv", "--reuid", USER, "--regid", USER, "--clear-groups"]
    # Through a shell: setpriv itself keeps the rights of root until the next program.
    probe = [*as_user, "sh", "-c", f"{HILRIG} --version"]
    if subprocess.run(probe, check=False, capture_output=True).returncode != 0:
        pytest.skip(f"user {USER} can't read the Python of this test: {HILRIG}")
    command = volumes.local("setup", PLAIN["services"]["setup"])
    for name in ("certs", "recordings"):
        os.chown(volumes.folder / name, int(USER), int(USER))
    for _ in range(2):
        done = subprocess.run([*as_user, *command], check=False, capture_output=True, text=True, env=environment())
        assert done.returncode == 0, done.stderr
    keys = list((volumes.folder / "certs/bus").glob("*.key"))
    assert {"router.key", "sim.key", "recorder.key", "viewer.key"} <= {key.name for key in keys}
    assert {key.stat().st_uid for key in keys} == {int(USER)}


@pytest.mark.hosts
@pytest.mark.timeout(300)
def test_services_run_in_their_order_and_the_demo_records(volumes: Volumes) -> None:
    require_namespaces()
    services = PLAIN["services"]
    done = subprocess.run(
        volumes.local("setup", services["setup"]), check=False, capture_output=True, text=True, env=environment()
    )
    assert done.returncode == 0, done.stderr
    assert {path.stat().st_uid for path in (volumes.folder / "certs").rglob("*")} == {int(USER)}
    with Network([*RUNNING, "demo"]) as network:
        processes = {}
        for name, service in RUNNING.items():
            with (volumes.folder / f"{name}.log").open("w") as log:
                command = volumes.local(name, service)
                processes[name] = network.popen(name, command, stdout=log, stderr=log, env=environment())

        def healthy(name: str) -> bool:
            return network.call(name, volumes.local(name, {"command": RUNNING[name]["healthcheck"]["test"][1:]})) == 0

        eventually(lambda: all(healthy(name) for name in RUNNING), timeout_s=90)
        command = [*volumes.local("demo", services["demo"]), "3"]
        driven = network.run(
            "demo", command, check=False, env=environment(), capture_output=True, text=True, timeout=LONG_TIMEOUT_S
        )
        assert driven.returncode == 0, driven.stderr
        (recording,) = (volumes.folder / "recordings/lab/rig1").glob("*.mcap")
        assert recording.with_suffix(".html").stat().st_size > 100_000
        for name, process in processes.items():
            assert process.poll() is None, (volumes.folder / f"{name}.log").read_text()
