"""`hilrig doctor` on each host distinguishes a cut link, a stopped and a killed service, and a dead router."""

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from hilrig_runtime.config.lab import load_lab
from support.multi_host_lab import MultiHostLab
from support.namespaces import Network, require_namespaces
from support.waiting import eventually

pytestmark = [pytest.mark.hosts, pytest.mark.rig, pytest.mark.timeout(180)]

COMMANDS = {
    "router": ["router", "--listen", "tcp/0.0.0.0:7447"],
    "sim": ["sim"],
    "edge": ["edge"],
    "recorder": ["recorder"],
}
LONG = pytest.mark.skipif("HILRIG_LONG" not in os.environ, reason="seven more seconds each: set HILRIG_LONG=1")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MultiHostLab]:
    require_namespaces()
    folder = tmp_path_factory.mktemp("doctor")
    config = folder / "lab.toml"
    config.write_text(
        f"[bus]\ntopology = 'router'\nrouter = 'tcp/router:7447'\n[edge]\nhost = '0.0.0.0'\n"
        f"[recorder]\nfolder = '{folder / 'recordings'}'\n"
    )
    with Network([*COMMANDS]) as network:
        made = MultiHostLab(network, config, load_lab(config), COMMANDS)
        for host in COMMANDS:
            made.start(host)
        eventually(lambda: not errors(made, "edge"))
        yield made


def errors(lab: MultiHostLab, host: str) -> list[str]:
    """Errors about bus and services that doctor finds on a host, each with its fix."""
    done = lab.run(host, "doctor", "--json", "-c", str(lab.config))
    findings = json.loads(done.stdout)["findings"]
    return [
        f"{one['text']} -> {one['fix']}"
        for one in findings
        if one["check"] in ("bus", "services") and one["level"] != "ok"
    ]


def seen_from_each_host(lab: MultiHostLab) -> dict[str, str]:
    """Errors on each host, in one text."""
    with ThreadPoolExecutor() as threads:
        found = threads.map(lambda host: " | ".join(errors(lab, host)), COMMANDS)
        return dict(zip(COMMANDS, found, strict=True))


def signal(lab: MultiHostLab, host: str, name: str) -> None:
    subprocess.run(["kill", f"-{name}", str(lab.processes[host].pid)], check=True)


@pytest.mark.parametrize(
    ("begin", "end", "own", "others"),
    [
        pytest.param(
            lambda lab: lab.network.set_link("sim", False),
            lambda lab: lab.network.set_link("sim", True),
            ["its host does not answer -> check the network link of this host first", "do not restart it"],
            ["run hilrig doctor on sim first"],
            id="cut",
        ),
        pytest.param(
            lambda lab: signal(lab, "sim", "STOP"),
            lambda lab: signal(lab, "sim", "CONT"),
            ["sim on this host is stopped", "continue it: kill -CONT"],
            ["run hilrig doctor on sim first", "received its last message"],
            id="stopped",
            marks=LONG,
        ),
        pytest.param(
            lambda lab: lab.kill("sim"),
            lambda lab: lab.start("sim"),
            ["not connected: sim", "start it here (hilrig sim)"],
            ["not connected: sim", "run hilrig doctor on sim first", "sim/1 on sim: edge/1 received its last message"],
            id="killed",
            marks=LONG,
        ),
    ],
)
def test_lost_simulation_is_explained_on_each_host(
    lab: MultiHostLab,
    begin: Callable[[MultiHostLab], None],
    end: Callable[[MultiHostLab], None],
    own: list[str],
    others: list[str],
) -> None:
    begin(lab)
    try:
        eventually(lambda: not lab.receives_states(), every_s=0.2)
        found = seen_from_each_host(lab)
        is_dead = lab.processes["sim"].poll() is not None
    finally:
        end(lab)
    for host, text in found.items():
        for part in own if host == "sim" else others:
            assert part in text, f"{host}: {text}"
        assert "-> restart" not in text
        assert "-> start it here" not in text or (host == "sim" and is_dead)
    eventually(lambda: not errors(lab, "edge"), every_s=0.2)


@LONG
def test_each_host_is_checked_for_its_own_service(lab: MultiHostLab) -> None:
    def checks(host: str) -> tuple[str, list[str]]:
        findings = json.loads(lab.run(host, "doctor", "--json", "-c", str(lab.config)).stdout)["findings"]
        return host, [one["check"] for one in findings]

    own = {
        "edge": {"ports", "open files", "punctuality"},
        "sim": {"punctuality"},
        "recorder": {"disk"},
        "router": set(),
    }
    with ThreadPoolExecutor() as threads:
        for host, found in threads.map(checks, COMMANDS):
            assert {"ports", "open files", "punctuality", "disk"} & set(found) == own[host], host


@LONG
def test_dead_router_is_explained_on_each_host(lab: MultiHostLab) -> None:
    lab.kill("router")
    try:
        found = seen_from_each_host(lab)
    finally:
        lab.start("router")
    for host, text in found.items():
        assert "no program listens on the port -> check on router whether the router runs" in text, f"{host}: {text}"
        if host != "router":
            assert f"{host} runs on this host" in text
            assert "do not restart it" in text
