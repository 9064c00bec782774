"""`hilrig record start RIG`, `hilrig record stop RIG`: manual recording sessions."""

from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config, config_for_commands

if TYPE_CHECKING:
    from pathlib import Path

    from hilrig_schemas import ControlRequest

app = typer.Typer(
    help="Record a rig manually, with or without a controller.",
    no_args_is_help=True,
    callback=config_for_commands,
)

Rig = Annotated[str, typer.Argument(metavar="RIG", help="Name of the rig.")]


@app.command()
def start(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """Start a manual recording of a rig."""
    from hilrig_schemas import ControlRequest, StartSession

    session = _request(config, rig, ControlRequest(start_session=StartSession(rig=rig)))
    _print(rig, session, f"recording {session}; stop it with `hilrig record stop {rig}`", as_json)


@app.command()
def stop(rig: Rig, config: Config = None, as_json: AsJson = False) -> None:
    """Stop the manual recording of a rig."""
    from hilrig_schemas import ControlRequest, StopSession

    session = _request(config, rig, ControlRequest(stop_session=StopSession(rig=rig)))
    _print(rig, session, f"recorded {session}", as_json)


def _request(config: "Path | None", rig: str, request: "ControlRequest") -> str:
    """Send a request to the recorder of a rig; return the id of the session."""
    from hilrig_cli.client import check_rig, discover_services, send_control_request
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError

    lab = load_lab(config)
    with ZenohBus(lab.bus, "tool") as bus:
        recorders = [one for one in discover_services(bus, lab, {"recorder"}) if one.service == "recorder"]
        if not recorders:
            raise OperationError(f"no recorder answers for lab {lab.name!r}: {lab.bus.no_answer_hint}")
        # Rigs that were added at run time belong to the recorder of the first rig in the lab's file.
        owner = next((one for one in recorders if rig in one.rigs), None)
        owner = owner or next((one for one in recorders if lab.rigs[0].name in one.rigs), recorders[0])
        try:
            return send_control_request(bus, lab, owner, request).session
        except OperationError:
            # The recorder also knows removed rigs, so it is queried first and an unknown name reported after that.
            check_rig(bus, lab, rig)
            raise


def _print(rig: str, session: str, text: str, as_json: bool) -> None:
    if as_json:
        import json

        print(json.dumps({"rig": rig, "session": session}))
    else:
        print(text)
