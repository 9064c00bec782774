"""`hilrig router`: zenoh router of a lab on several hosts."""

from typing import Annotated

import typer

from hilrig_cli.commands.services import LogFormat, StopWithParent
from hilrig_cli.options import Config, announcer


def router(
    config: Config = None,
    listen: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT",
            help="Endpoint to listen on, such as tls/0.0.0.0:7447; default: bus.router of lab.toml.",
        ),
    ] = "",
    print_only: Annotated[
        bool, typer.Option("--print", help="Print the configuration for zenoh's own router (zenohd -c) and exit.")
    ] = False,
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the zenoh router of a lab; with \\[bus.tls], with access control by certificate."""
    from hilrig_runtime.bus.zenoh_config import router_config
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.process.logging_setup import start_logging
    from hilrig_runtime.process.router import router_endpoint, run_router

    start_logging("router", "1", log_format)
    lab = load_lab(config)
    if print_only:
        print(router_config(lab.bus, lab.name, router_endpoint(lab, listen)))
        return
    run_router(lab, listen, announcer(log_format), stop_with_parent=stop_with_parent)
