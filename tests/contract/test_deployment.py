"""The files of examples/deployment are accepted by their programs and have the default ports."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.config.lab import EdgeConfig

FOLDER = Path(__file__).parents[2] / "examples/deployment"
SERVICES = ("router", "sim", "edge", "recorder", "console", "metrics")
RIGS = 64


def test_systemd_accepts_the_unit_of_each_service(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze (Debian's package systemd)")
    unit = (FOLDER / "hilrig@.service").read_text()
    program = re.findall(r"^ExecStart=(\S+)", unit, re.MULTILINE)
    assert program == ["/opt/hilrig/bin/hilrig"]
    # systemd-analyze checks that the program exists.
    files = [tmp_path / f"hilrig@{service}.service" for service in SERVICES]
    for path in files:
        path.write_text(unit.replace(program[0], str(Path(sys.executable))))
    command = ["systemd-analyze", "verify", "--man=no", *map(str, files)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=30)
    assert (done.returncode, [line for line in done.stderr.splitlines() if "hilrig@" in line]) == (0, [])


def test_unit_runs_commands_with_a_configuration_file() -> None:
    from hilrig_cli import main

    names = {command.name or command.callback.__name__ for command in main.app.registered_commands if command.callback}
    assert set(SERVICES) <= names


def test_firewall_has_the_default_ports() -> None:
    rules = (FOLDER / "hilrig.nft").read_text()
    edge, bus = EdgeConfig().first_port, BusConfig().first_port
    tls = TlsConfig.model_fields["first_port"].default
    ranges = {f"{first}-{first + count - 1}" for first, count in ((edge, RIGS), (tls, RIGS), (bus, 3))}
    assert ranges == set(re.findall(r"\d+-\d+", rules))
    (dropped,) = re.findall(r"tcp dport \{ (.*) \} drop", rules)
    assert set(dropped.split(", ")) == ranges | {"8050", "9464"}


def test_nft_accepts_the_firewall() -> None:
    if shutil.which("nft") is None:
        pytest.skip("needs nft (Debian's package nftables)")
    if os.geteuid() != 0:
        pytest.skip("needs root, as nft reads the rules of the system")
    subprocess.run(["nft", "-c", "-f", FOLDER / "hilrig.nft"], check=True, capture_output=True, timeout=30)
