"""`hilrig rig`: which rigs a running lab has, and having more or fewer of them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilrig_cli.options import AsJson, Config, config_for_commands

if TYPE_CHECKING:
    from hilrig_runtime.bus.api import Bus
    from hilrig_runtime.config.lab import LabConfig, RigSettings
    from hilrig_schemas import Event, ServiceInfo

app = typer.Typer(
    help="See which rigs a running lab has; add, take away or reset one.",
    no_args_is_help=True,
    callback=config_for_commands,
)

Name = Annotated[str, typer.Argument(metavar="RIG", help="The rig's name.")]


@app.command(name="list")
def list_rigs(config: Config = None, as_json: AsJson = False) -> None:
    """Print each rig with who simulates and who serves it, those of the lab's file and those added since."""
    from rich.console import Console
    from rich.table import Table

    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab

    lab = load_lab(config)
    with ZenohBus(lab.bus, "rig") as bus:
        rows = _rows(lab, _list_services(bus, lab))
    if as_json:
        print(json.dumps(rows))
        return
    table = Table()
    for column in ("rig", "at", "simulation", "edge", "from"):
        table.add_column(column)
    for row in rows:
        origin = "lab.toml" if row["in_file"] else "added"
        table.add_row(row["rig"], row["address"], row["sim"] or "none", row["edge"] or "none", origin)
    Console().print(table)


@app.command()
def add(
    rig: Name,
    port: Annotated[
        int | None,
        typer.Option(help="Modbus TCP port; without: the next free one behind the others.", show_default=False),
    ] = None,
    settings: Annotated[
        Path | None,
        typer.Option(metavar="RIG.TOML", help="What differs from the lab, as in \\[\\[rigs]].", show_default=False),
    ] = None,
    config: Config = None,
) -> None:
    """Add a rig to a running lab; the others do not feel it.

    It is there until the lab ends, or its simulation or edge is started anew: to keep it, write it into lab.toml too.
    """
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import HilrigError, OperationError
    from hilrig_schemas import Event

    lab = load_lab(config)
    with ZenohBus(lab.bus, "rig") as bus:
        infos = _list_services(bus, lab)
        new = _settings(infos, rig, port, settings)
        simulation = _least_loaded(infos, "sim", lab)
        edge = _least_loaded(infos, "edge", lab)
        request = Event(kind=Event.RIG_ADDED, rig=rig)
        request.configuration_data.text = new.model_dump_json()
        _ask(bus, lab, simulation, request)
        try:
            done = _ask(bus, lab, edge, request)
        except HilrigError as error:
            # Both or none: a rig that nobody serves must not be left behind.
            _ask(bus, lab, simulation, Event(kind=Event.RIG_REMOVED, rig=rig))
            raise OperationError(f"{rig} was not added: {error}") from error
    print(done.text)


@app.command()
def remove(rig: Name, config: Config = None) -> None:
    """Take a rig away from a running lab: no torque, its session ends, its port closes; the others do not feel it."""
    from hilrig_cli.client import SERVING, check_rig
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas import Event

    lab = load_lab(config)
    with ZenohBus(lab.bus, "rig") as bus:
        owners = [info for info in _list_services(bus, lab) if rig in info.rigs and info.service in SERVING]
        if not owners:
            check_rig(bus, lab, rig)
            raise OperationError(f"no running service has {rig}: hilrig rig list shows those that there are")
        # The edge first: its last word is that there is no torque.
        for info in sorted(owners, key=lambda info: info.service):
            print(_ask(bus, lab, info, Event(kind=Event.RIG_REMOVED, rig=rig)).text)


@app.command()
def reset(rig: Name, config: Config = None) -> None:
    """Put a rig's arm and parts back to the start; a controller that holds it goes on from there."""
    from hilrig_cli.client import check_rig
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas import Event

    lab = load_lab(config)
    with ZenohBus(lab.bus, "rig") as bus:
        for info in _list_services(bus, lab):
            if info.service == "edge" and rig in info.rigs:
                print(_ask(bus, lab, info, Event(kind=Event.RESET, rig=rig)).text)
                return
        check_rig(bus, lab, rig)
    raise OperationError(f"no edge serves {rig}: hilrig rig list shows those that there are")


def _list_services(bus: "Bus", lab: "LabConfig") -> "list[ServiceInfo]":
    from hilrig_cli.client import list_all_services
    from hilrig_runtime.errors import OperationError

    found = list_all_services(bus, lab, {"sim", "edge"})
    if not found:
        raise OperationError(f"nothing is heard of lab {lab.name!r}: is it running (hilrig up), with this lab.toml?")
    return found


def _rows(lab: "LabConfig", infos: "list[ServiceInfo]") -> list[dict[str, Any]]:
    in_file = [rig.name for rig in lab.rigs]
    names = dict.fromkeys([*in_file, *(rig for info in infos if info.service == "edge" for rig in info.rigs)])
    rows = []
    for name in names:
        row: dict[str, Any] = {"rig": name, "in_file": name in in_file, "address": "", "sim": "", "edge": ""}
        for info in infos:
            if name in info.rigs and info.service in row:
                row[info.service] = f"{info.instance} on {info.host}"
                row["address"] = row["address"] or info.addresses[list(info.rigs).index(name)]
        rows.append(row)
    return rows


def _settings(infos: "list[ServiceInfo]", rig: str, port: int | None, settings: Path | None) -> "RigSettings":
    import tomllib

    from hilrig_runtime.config.lab import read_lab_text, read_rig
    from hilrig_runtime.errors import InputError

    if any(rig in info.rigs for info in infos if info.service in ("sim", "edge")):
        raise InputError(f"the lab has a rig called {rig!r} already")
    try:
        said = {} if settings is None else tomllib.loads(read_lab_text(settings))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{settings}: no valid TOML: {error}") from error
    if port is not None:
        said["port"] = port
    return read_rig(json.dumps(said | {"name": rig}))


def _least_loaded(infos: "list[ServiceInfo]", service: str, lab: "LabConfig") -> "ServiceInfo":
    from hilrig_runtime.errors import OperationError

    able = [info for info in infos if info.service == service]
    if not able:
        raise OperationError(f"no {service} of lab {lab.name!r} is heard: is it running?")
    return min(able, key=lambda info: len(info.rigs))


def _ask(bus: "Bus", lab: "LabConfig", info: "ServiceInfo", request: "Event") -> "Event":
    from hilrig_cli.client import ANSWER_WITHIN_S
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas import Event, topics

    key = topics.CONTROL.key(lab.name, info.service, info.instance)
    answers = bus.query(key, request.SerializeToString(), timeout_s=ANSWER_WITHIN_S)
    if not answers:
        raise OperationError(f"{info.service}/{info.instance} on {info.host} does not answer")
    if answers[0].error:
        raise OperationError(f"{info.service}/{info.instance} on {info.host} refused: {answers[0].error}")
    return Event.FromString(answers[0].payload)
