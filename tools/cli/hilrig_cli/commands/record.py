"""`hilrig record start RIG`, `hilrig record stop RIG`: manual recording sessions."""

from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config, config_for_commands

if TYPE_CHECKING:
    from pathlib import Path

    from hilrig_schemas import Event

QUERY_TIMEOUT_S = 5.0
"""Timeout of a query to the recorder."""

app = typer.Typer(
    help="Record a rig manually, with or without a controller.",
    no_args_is_help=True,
    callback=config_for_commands,
)

Rig = Annotated[str, typer.Argument(metavar="RIG", help="Name of the rig.")]


@app.command()
def start(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """Start a manual recording of a rig."""
    from hilrig_schemas import Event

    event = _request(config, Event(kind=Event.SESSION_START, rig=rig))
    _print(event, f"recording {event.session}; stop it with `hilrig record stop {rig}`", as_json)


@app.command()
def stop(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """Stop the manual recording of a rig."""
    from hilrig_schemas import Event

    event = _request(config, Event(kind=Event.SESSION_END, rig=rig))
    _print(event, f"recorded {event.session}", as_json)


def _request(config: "Path | None", request: "Event") -> "Event":
    from hilrig_cli.client import check_rig, discover_services
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas.topics import CONTROL

    lab = load_lab(config)
    with ZenohBus(lab.bus, "tool") as bus:
        recorders = [one for one in discover_services(bus, lab, {"recorder"}) if one.service == "recorder"]
        if not recorders:
            raise OperationError(
                f"no recorder answers for lab {lab.name!r}: is it running (hilrig up), with this lab.toml?"
            )
        # Rigs that were added at run time belong to the recorder of the first rig in the lab's file.
        owner = next((one for one in recorders if request.rig in one.rigs), None)
        owner = owner or next((one for one in recorders if lab.rigs[0].name in one.rigs), recorders[0])
        key = CONTROL.key(lab.name, owner.service, owner.instance)
        for reply in bus.query(key, request.SerializeToString(), timeout_s=QUERY_TIMEOUT_S):
            if reply.error:
                # The recorder also knows removed rigs, so it is queried first and an unknown name reported after that.
                check_rig(bus, lab, request.rig)
                raise OperationError(reply.error)
            return CONTROL.decode(reply.payload)
    raise OperationError(f"{owner.service}/{owner.instance} does not reply within {QUERY_TIMEOUT_S:g} s: see its log")


def _print(event: "Event", text: str, as_json: bool) -> None:
    if as_json:
        import json

        print(json.dumps({"rig": event.rig, "session": event.session}))
    else:
        print(text)
