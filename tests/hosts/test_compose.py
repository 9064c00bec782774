"""compose.yaml: what it says is started for real, each service on a host of its own."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from hilrig_runtime.config import load_lab
from namespaces import Network, require_namespaces
from waiting import eventually

ROOT = Path(__file__).parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = ("sim", "edge", "recorder")
HILRIG = str(Path(sys.executable).with_name("hilrig"))

CONTROLLER = """
import sys, time
from pymodbus.client import ModbusTcpClient

client = ModbusTcpClient(sys.argv[1], port=5020, timeout=2)
assert client.connect(), "no connection"
for _ in range(60):
    before = client.read_holding_registers(4, count=4).registers
    assert not client.write_registers(0, [500, 0, 0, 0]).isError()
    time.sleep(0.02)
after = client.read_holding_registers(4, count=4).registers
print(before[0], after[0])
client.close()
"""


def test_every_service_runs_a_command_of_ours_on_a_lab_that_is_mounted() -> None:
    for name in SERVICES:
        service = COMPOSE["services"][name]
        program, command, option, config = service["command"]
        assert (program, command, option) == ("hilrig", name, "--config")
        assert f"./compose/lab.toml:{config}:ro" in service["volumes"]
        assert service["build"]["args"]["PARTS"] == name
        assert service["restart"] == "unless-stopped"


def test_the_lab_and_the_compose_file_agree() -> None:
    lab = load_lab(ROOT / "compose/lab.toml")
    assert lab.bus.topology == "router"
    assert lab.bus.router == "tcp/router:7447"
    assert "tcp/0.0.0.0:7447" in COMPOSE["services"]["router"]["command"]
    ports = list(lab.ports.values())
    assert COMPOSE["services"]["edge"]["ports"] == [f"127.0.0.1:{ports[0]}-{ports[-1]}:{ports[0]}-{ports[-1]}"]
    assert f"./recordings:{lab.recorder.folder}" in COMPOSE["services"]["recorder"]["volumes"]


def test_the_image_copies_what_the_build_reads_and_installs_the_parts_that_compose_names() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    for folder in ("schemas", "runtime", "services", "tools", "examples"):
        assert f"COPY {folder} {folder}" in dockerfile
    pyproject = (ROOT / "pyproject.toml").read_text()
    for name in SERVICES:
        assert f"\n{name} = [" in pyproject


@pytest.mark.hosts
def test_the_services_find_each_other_by_name_and_a_controller_moves_the_arm(tmp_path: Path) -> None:
    require_namespaces()
    recordings = tmp_path / "recordings"
    lab = tmp_path / "lab.toml"
    lab.write_text((ROOT / "compose/lab.toml").read_text().replace('"/recordings"', f'"{recordings}"'))
    router_arguments = COMPOSE["services"]["router"]["command"]
    with Network(["router", *SERVICES, "controller"]) as network:
        processes = {}
        # The services come first: each waits for its router.
        for name in SERVICES:
            command = [HILRIG if word == "hilrig" else word for word in COMPOSE["services"][name]["command"]]
            command[-1] = str(lab)
            processes[name] = network.popen(name, command)
        router = [sys.executable, str(ROOT / "tests/zenoh_router.py"), *router_arguments]
        network.popen("router", router, stdin=subprocess.PIPE)

        def drive() -> tuple[int, int] | None:
            command = [sys.executable, "-c", CONTROLLER, "edge"]
            try:
                output = network.run(
                    "controller", command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
                )
            except subprocess.CalledProcessError:
                return None
            before, after = map(int, output.stdout.split())
            return (before, after) if after != before else None

        before, after = eventually(drive, timeout_s=40, every_s=0.2)
        assert after > before
        assert all(process.poll() is None for process in processes.values())
        for name in ("edge", "sim", "recorder"):
            processes[name].terminate()
            assert processes[name].wait(5) == 0, f"{name} did not end well on SIGTERM"
    assert list(recordings.rglob("*.mcap")), "the session was recorded"
    assert not list(recordings.rglob("*.part"))
