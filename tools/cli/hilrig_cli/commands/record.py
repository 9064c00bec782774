"""`hilrig record start RIG`, `hilrig record stop RIG`: manual recording sessions."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from hilrig_cli.options import AllRigs, AsJson, Config, Rigs, check_rigs, config_for_commands

if TYPE_CHECKING:
    from pathlib import Path

    from hilrig_schemas import ControlRequest

app = typer.Typer(
    help="Record a rig manually, with or without a controller.",
    no_args_is_help=True,
    callback=config_for_commands,
)


@app.command()
def start(rigs: Rigs = None, every: AllRigs = False, config: Config = None, as_json: AsJson = False) -> None:
    """Start a manual recording of each rig."""
    from hilrig_schemas import ControlRequest, StartSession

    sessions = _request(config, rigs, every, lambda rig: ControlRequest(start_session=StartSession(rig=rig)))
    _print(sessions, "recording {session}; stop it with `hilrig record stop {rig}`", as_json)


@app.command()
def stop(rigs: Rigs = None, every: AllRigs = False, config: Config = None, as_json: AsJson = False) -> None:
    """Stop the manual recording of each rig."""
    from hilrig_schemas import ControlRequest, StopSession

    sessions = _request(config, rigs, every, lambda rig: ControlRequest(stop_session=StopSession(rig=rig)))
    _print(sessions, "recorded {session}", as_json)


def _request(
    config: "Path | None", rigs: list[str] | None, every: bool, request: "Callable[[str], ControlRequest]"
) -> dict[str, str]:
    """Send a request to the recorder of each rig; return the id of each rig's session."""
    from hilrig_cli.client import check_rig, discover_services, send_control_request
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError

    check_rigs(rigs, every, "hilrig record")
    lab = load_lab(config)
    sessions: dict[str, str] = {}
    with ZenohBus(lab.bus, "tool") as bus:
        recorders = [one for one in discover_services(bus, lab, {"recorder"}) if one.service == "recorder"]
        if not recorders:
            raise OperationError(f"no recorder answers for lab {lab.name!r}: {lab.bus.no_answer_hint}")
        owners = {rig: one for one in recorders for rig in one.rigs}
        # Rigs that were added at run time belong to the recorder of the first rig in the lab's file.
        default = owners.get(lab.rigs[0].name, recorders[0])
        for rig in rigs or owners:
            try:
                sessions[rig] = send_control_request(bus, lab, owners.get(rig, default), request(rig)).session
            except OperationError as error:
                # The recorder also knows removed rigs, so it is queried first and an unknown name reported after that.
                check_rig(bus, lab, rig)
                done = f"; done for {', '.join(sessions)}" if sessions else ""
                raise OperationError(f"{error}{done}") from error
    return sessions


def _print(sessions: dict[str, str], text: str, as_json: bool) -> None:
    from hilrig_cli.json_output.lab import RecordOutput
    from hilrig_cli.json_output.model import print_json

    if as_json:
        rows = [RecordOutput(rig=rig, session=session) for rig, session in sessions.items()]
        print_json(rows[0] if len(rows) == 1 else rows)
    else:
        for rig, session in sessions.items():
            print(text.format(rig=rig, session=session))
