"""Checks of controllers that are Modbus servers: their addresses and registers."""

import socket
from collections.abc import Collection, Iterator

from hilrig_cli.doctor import CheckResult
from hilrig_modbus_edge.client.exchange import ExchangeSettings
from hilrig_modbus_edge.client.probe import probe_controller
from hilrig_runtime.config.controller import parse_controller
from hilrig_runtime.config.lab import LabConfig


def check_controllers(lab: LabConfig, running: Collection[str]) -> Iterator[CheckResult]:
    """Read the registers of each controller whose client the edge is, or say why not.

    Args:
        lab: the lab.
        running: kinds of service that are alive on the bus.
    """
    rig_at: dict[tuple[str, int], str] = {}
    for rig in lab.rigs:
        if rig.controller is None:
            continue
        host, port = parse_controller(rig.controller)
        others = {rig_at.setdefault((address, port), rig.name) for address in _addresses(host)} - {rig.name}
        if others:
            names = ", ".join(repr(other) for other in sorted(others))
            text = f"rig {rig.name!r}: {rig.controller} is also the controller of {names}"
            yield CheckResult.error("controllers", text, "give each rig a controller of its own, in [[rigs]]")
            continue
        if "edge" in running:
            # Many controllers accept one client only, and the edge is that one.
            text = f"rig {rig.name!r}: {rig.controller} is not tested while the edge runs; see hilrig lease"
            yield CheckResult.ok("controllers", text)
            continue
        defects = probe_controller(ExchangeSettings.of(rig, lab.sim.step_ns))
        for defect in defects:
            text = f"rig {rig.name!r}: controller {rig.controller}: {defect}"
            yield CheckResult.error("controllers", text, "correct [[rigs]] in lab.toml, or the controller")
        if not defects:
            yield CheckResult.ok("controllers", f"rig {rig.name!r}: {rig.controller} has all registers")


def _addresses(host: str) -> set[str]:
    """Return the addresses of a host; empty: its name has none."""
    try:
        return {str(found[4][0]) for found in socket.getaddrinfo(host, None)}
    except OSError:
        return set()
