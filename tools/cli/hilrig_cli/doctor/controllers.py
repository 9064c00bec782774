"""Checks of controllers that are Modbus servers: their addresses and registers."""

from collections.abc import Collection, Iterator

from hilrig_cli.doctor import CheckResult
from hilrig_modbus_edge.client.exchange import ExchangeSettings
from hilrig_modbus_edge.client.probe import probe_controller
from hilrig_runtime.config.lab import LabConfig


def check_controllers(lab: LabConfig, running: Collection[str]) -> Iterator[CheckResult]:
    """Read the registers of each controller whose client the edge is, or say why not.

    Args:
        lab: the lab.
        running: kinds of service that are alive on the bus.
    """
    for rig in lab.rigs:
        if rig.controller is None:
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
