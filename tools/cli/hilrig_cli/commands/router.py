"""`hilrig router`: zenoh router of a lab on several hosts."""

from typing import Annotated

import typer

from hilrig_cli.commands.services import StopWithParent
from hilrig_cli.options import Config


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
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the zenoh router of a lab; with \\[bus.tls], with access control by certificate."""
    from hilrig_runtime.bus.zenoh_config import router_config
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.process.router import router_endpoint, run_router

    lab = load_lab(config)
    if print_only:
        print(router_config(lab.bus, lab.name, router_endpoint(lab, listen)))
        return
    run_router(lab, listen, stop_with_parent=stop_with_parent)
