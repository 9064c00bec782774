"""The zenoh router of a lab, as a process of ours: the router that zenoh embeds, with the lab's rules of access."""

import threading
from contextlib import closing

import zenoh

from hilrig_runtime.bus.zenoh_config import ROUTER, router_config, system_reason
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.shutdown import (
    CLOSE_TIMEOUT_S,
    force_exit_after,
    stop_on_signals,
    stop_with_stdin,
    wait_for,
)
from hilrig_schemas.topics import alive_key


def router_endpoint(lab: LabConfig, listen: str) -> str:
    """Where the lab's router listens: at `listen`, or, where that is empty, where the lab says that its router is.

    Raises:
        InputError: the lab has no router, or `listen` is no endpoint of its kind.
    """
    if lab.bus.topology != "router":
        raise InputError('this lab has no router: bus.topology in lab.toml is "mesh"; write "router" there')
    endpoint = listen or lab.bus.router
    kind = "tcp/" if lab.bus.tls is None else "tls/"
    if not endpoint.startswith(kind):
        raise InputError(f"--listen {endpoint}: expected {kind}<address>:<port>, as bus.router in lab.toml")
    return endpoint


def run_router(lab: LabConfig, listen: str, *, stop_with_parent: bool = False) -> None:
    """Route for a lab until told to stop; `listen` as in `router_endpoint`.

    Raises:
        InputError: as `router_endpoint`, or a certificate is not there.
        OperationError: the endpoint can't be had.
    """
    endpoint = router_endpoint(lab, listen)
    stopping = threading.Event()
    stop_on_signals(stopping)
    if stop_with_parent:
        stop_with_stdin(stopping)
    force_exit_after(stopping, CLOSE_TIMEOUT_S)
    config = router_config(lab.bus, lab.name, endpoint)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise OperationError(
            f"the router can't listen on {endpoint} ({system_reason(error)}): end what listens there, "
            "or choose another --listen"
        ) from error
    with closing(session), session.liveliness().declare_token(alive_key(lab.name, ROUTER, "1")):
        print(f"router of lab {lab.name!r} at {endpoint}", flush=True)
        wait_for(stopping)
