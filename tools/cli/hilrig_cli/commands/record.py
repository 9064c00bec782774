"""`hilrig record start RIG`, `hilrig record stop RIG`: a session by hand, beside those that controllers begin."""

from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config, config_for_commands

if TYPE_CHECKING:
    from pathlib import Path

    from hilrig_schemas import Event

ANSWER_TIMEOUT_S = 5.0
"""How long a recorder has to answer."""

app = typer.Typer(
    help="Record a rig by hand, whether a controller is there or not.",
    no_args_is_help=True,
    callback=config_for_commands,
)

Rig = Annotated[str, typer.Argument(metavar="RIG", help="The rig's name.")]


@app.command()
def start(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """Begin to record a rig."""
    from hilrig_schemas import Event

    event = _ask(config, Event(kind=Event.SESSION_START, rig=rig))
    _print(event, f"recording {event.session}: `hilrig record stop {rig}` ends it", as_json)


@app.command()
def stop(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """End the recording of a rig that was begun by hand."""
    from hilrig_schemas import Event

    event = _ask(config, Event(kind=Event.SESSION_END, rig=rig))
    _print(event, f"recorded {event.session}", as_json)


def _ask(config: "Path | None", request: "Event") -> "Event":
    from hilrig_cli.client import check_rig, list_all_services
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas.topics import CONTROL

    lab = load_lab(config)
    with ZenohBus(lab.bus, "tool") as bus:
        recorders = [one for one in list_all_services(bus, lab, {"recorder"}) if one.service == "recorder"]
        if not recorders:
            raise OperationError(
                f"no recorder answers for lab {lab.name!r}: is it running (hilrig up), with this lab.toml?"
            )
        # Rigs that were added since are the one's that has the first of the lab's file.
        has = next((one for one in recorders if request.rig in one.rigs), None)
        has = has or next((one for one in recorders if lab.rigs[0].name in one.rigs), recorders[0])
        key = CONTROL.key(lab.name, has.service, has.instance)
        for answer in bus.query(key, request.SerializeToString(), timeout_s=ANSWER_TIMEOUT_S):
            if answer.error:
                # A recorder knows of rigs that were taken away: it is asked first, and a name that is none told after.
                check_rig(bus, lab, request.rig)
                raise OperationError(answer.error)
            return CONTROL.decode(answer.payload)
    raise OperationError(f"{has.service}/{has.instance} does not answer: see its log")


def _print(event: "Event", text: str, as_json: bool) -> None:
    if as_json:
        import json

        print(json.dumps({"rig": event.rig, "session": event.session}))
    else:
        print(text)
