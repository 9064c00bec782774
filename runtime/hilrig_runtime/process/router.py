"""Runs the zenoh router of a lab: the router embedded in the zenoh library, with the lab's access rules."""

from collections.abc import Callable
from contextlib import closing

import zenoh

from hilrig_runtime.bus.zenoh_config import ROUTER, router_config, system_reason
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.shutdown import CLOSE_TIMEOUT_S, force_exit_after, stop_on_signals, wait_for
from hilrig_schemas.topics import alive_key


def router_endpoint(lab: LabConfig, listen: str) -> str:
    """Return the endpoint on which the lab's router listens: `listen`, or if that is empty, `bus.router` of the lab.

    Raises:
        InputError: the lab has no router, or `listen` is not a valid endpoint.
    """
    if lab.bus.topology != "router":
        raise InputError('this lab has no router: bus.topology in lab.toml is "mesh"; set it to "router"')
    endpoint = listen or lab.bus.router
    kind = "tcp/" if lab.bus.tls is None else "tls/"
    if not endpoint.startswith(kind):
        raise InputError(f"--listen: must be {kind}<address>:<port>, as bus.router in lab.toml, got {endpoint!r}")
    return endpoint


def run_router(lab: LabConfig, listen: str, announce: Callable[[str], None], *, stop_with_parent: bool = False) -> None:
    """Run the lab's router until it is stopped; `listen` as in `router_endpoint`, which is announced.

    Raises:
        InputError: as `router_endpoint`, or a certificate is missing.
        OperationError: the endpoint is not available.
    """
    endpoint = router_endpoint(lab, listen)
    stopping = stop_on_signals(stop_with_parent=stop_with_parent)
    force_exit_after(stopping, CLOSE_TIMEOUT_S)
    config = router_config(lab.bus, lab.name, endpoint)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise OperationError(
            f"the router can't listen on {endpoint} ({system_reason(error)}): stop the program that uses the port, "
            "or choose another --listen"
        ) from error
    with closing(session), session.liveliness().declare_token(alive_key(lab.name, ROUTER, "1")):
        announce(f"router of lab {lab.name!r} at {endpoint}")
        wait_for(stopping)
