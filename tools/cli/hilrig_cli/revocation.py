"""Revocation of a controller's certificate: every edge reads its file again and closes the controller's connections."""

from hilrig_cli.client import discover_services, send_control_request
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import HilrigError, InputError, OperationError, list_names
from hilrig_schemas import ControlRequest, RevokeClient


def revoke_client(lab: LabConfig, name: str) -> dict[str, str]:
    """Withdraw the right of a certificate to write at all edges of a running lab; return the reply of each edge.

    Raises:
        InputError: the lab has no file, or no Modbus/TCP Security.
        OperationError: lab.toml still lists the name, here or at an edge, or an edge does not answer; the others have
            done it.
    """
    tls, where = lab.edge.tls, str(lab.path)
    if tls is None:
        raise InputError(f"--revoke: {where if lab.path else 'the lab'} has no [edge.tls]; name the file with --config")
    tls.check_revoked(name, where)
    request = ControlRequest(revoke_client=RevokeClient(name=name))
    results: dict[str, str] = {}
    failures: list[str] = []
    with ZenohBus(lab.bus, "tool") as bus:
        edges = [info for info in discover_services(bus, lab, {"edge"}) if info.service == "edge"]
        for info in edges:
            edge = f"{info.service}/{info.instance} on {info.host}"
            try:
                results[edge] = f"{edge}: {send_control_request(bus, lab, info, request).text}"
            except HilrigError as error:
                failures.append(str(error))
    served = {rig for info in edges for rig in info.rigs}
    missing = [rig.name for rig in lab.rigs if rig.name not in served]
    if missing:
        failures.append(
            f"no edge answers for {list_names(missing)}: its edge reads lab.toml when it starts; if it runs without a "
            "connection to the bus, restart it"
        )
    if failures:
        done = [f"{edge} has done it" for edge in results]
        raise OperationError("\n".join([f"{name} is not revoked everywhere:", *failures, *done]))
    return results
