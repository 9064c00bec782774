"""`hilrig rig`: lists, adds, removes and resets rigs of a running lab; makes the codes that claim rigs."""

import json
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilrig_cli.options import AllRigs, AsJson, Config, Rigs, check_rigs, config_for_commands

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hilrig_runtime.bus.api import Bus
    from hilrig_runtime.config.lab import LabConfig, RigSettings
    from hilrig_schemas import ServiceInfo

app = typer.Typer(
    help="List, add, remove or reset rigs of a running lab; make the codes with which students claim rigs.",
    no_args_is_help=True,
    callback=config_for_commands,
)

Name = Annotated[str, typer.Argument(metavar="RIG", help="Name of the rig.")]


@app.command(name="list")
def list_rigs(config: Config = None, as_json: AsJson = False) -> None:
    """List the rigs of a running lab with their addresses, simulation and edge, including rigs added at run time."""

    from hilrig_cli.json_output.lab import RigListOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    with _join(config) as (lab, _, found):
        rows = _rows(lab, found)
    if as_json:
        print_json([RigListOutput.model_validate(row) for row in rows])
        return
    table = TerminalTable("rig", "address", "simulation", "edge", "source")
    for row in rows:
        origin = "lab.toml" if row["in_file"] else "added"
        table.add_row(row["rig"], row["address"], row["sim"] or "none", row["edge"] or "none", origin)
    TerminalConsole().print(table)


@app.command()
def add(
    rig: Name,
    port: Annotated[
        int | None,
        typer.Option(help="Modbus TCP port; default: the next free port after the lab's ports."),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="HOST[:PORT]", help="Controller that is a Modbus server; the edge becomes its client."),
    ] = None,
    settings: Annotated[
        Path | None,
        typer.Option(
            metavar="RIG.TOML",
            help="File with settings that differ from the lab's; keys as in \\[\\[rigs]].",
        ),
    ] = None,
    config: Config = None,
) -> None:
    """Add a rig to a running lab; other rigs are not affected.

    The rig exists until the lab stops, or its simulation or edge restarts. To keep it, add it to lab.toml too.
    """
    from hilrig_cli.client import send_control_request
    from hilrig_runtime.errors import HilrigError, OperationError
    from hilrig_schemas import AddRig, ControlRequest, RemoveRig

    with _join(config) as (lab, bus, found):
        new = _settings(found, rig, {"port": port, "controller": controller}, settings)
        simulation = _least_loaded(found, "sim", lab)
        edge = _least_loaded(found, "edge", lab)
        request = ControlRequest(add_rig=AddRig(settings_json=new.model_dump_json()))
        send_control_request(bus, lab, simulation, request)
        try:
            reply = send_control_request(bus, lab, edge, request)
        except HilrigError as error:
            # Atomic: if the edge refuses the rig, the simulation must not keep it.
            send_control_request(bus, lab, simulation, ControlRequest(remove_rig=RemoveRig(rig=rig)))
            raise OperationError(f"rig {rig!r} was not added: {error}") from error
    print(reply.text)


@app.command()
def remove(rig: Name, config: Config = None) -> None:
    """Remove a rig from a running lab: its torque is zeroed, its session ends, its port is closed."""
    from hilrig_cli.client import check_rig, send_control_request
    from hilrig_cli.service_kinds import RIG_SERVICES, STOP_ORDER
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas import ControlRequest, RemoveRig

    with _join(config) as (lab, bus, found):
        owners = [info for info in found if rig in info.rigs and info.service in RIG_SERVICES]
        if not owners:
            check_rig(bus, lab, rig)
            raise OperationError(f"no running service has rig {rig!r}; hilrig rig list shows the existing rigs")
        # The edge first: its last command is zero torque.
        for info in sorted(owners, key=lambda info: STOP_ORDER.index(info.service)):
            print(send_control_request(bus, lab, info, ControlRequest(remove_rig=RemoveRig(rig=rig))).text)


@app.command()
def reset(rigs: Rigs = None, every: AllRigs = False, config: Config = None) -> None:
    """Reset the arm and parts of rigs to their start; the controller that holds the lease stays connected."""
    from hilrig_cli.client import check_rig, send_control_request
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas import ControlRequest, ResetRig

    check_rigs(rigs, every, "hilrig rig reset")
    with _join(config) as (lab, bus, found):
        edges = {rig: info for info in found if info.service == "edge" for rig in info.rigs}
        for rig in rigs or sorted(edges):
            if rig not in edges:
                check_rig(bus, lab, rig)
                raise OperationError(f"no edge serves rig {rig!r}; hilrig rig list shows the existing rigs")
            print(send_control_request(bus, lab, edges[rig], ControlRequest(reset_rig=ResetRig(rig=rig))).text)


@app.command()
def codes(
    until: Annotated[
        str, typer.Option(metavar="TIME", help="End of the lab slot: HH:MM, or date and time as '2026-12-01 11:30'.")
    ],
    group: Annotated[str, typer.Option(help="Only the students of this group.")] = "",
    student: Annotated[
        list[str] | None, typer.Option(metavar="ID", help="Only this student, as for a lost code; may be repeated.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE.CSV", help="Also write the codes to this file.")
    ] = None,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Make the codes with which the students of a lab slot claim their rigs (hilrig claim), and print them.

    The codes go to the folder classroom.claims of lab.toml, as hashes; edges read them at the next claim. The old codes
    of these students are no longer valid; claims that were made with them stay until their end.
    """
    from datetime import datetime

    from hilrig_classroom.slot_codes import codes_csv, issue_codes, parse_end, select_students
    from hilrig_cli.json_output.lab import RigCodesOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_runtime.config.claim_codes import replace_private_file
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError, OperationError

    lab, now = load_lab(config), datetime.now().astimezone()
    if lab.classroom is None or lab.classroom.claims is None:
        raise InputError("lab.toml has no classroom.claims: add the folder of codes and claims, and --config")
    ends = parse_end(until, now)
    students = select_students(lab.classroom.students([one.name for one in lab.rigs]), group, student or [])
    made = issue_codes(lab.classroom.claims, students, ends, now)
    if out is not None:
        try:
            replace_private_file(out, codes_csv(students, made, ends))
        except OSError as error:
            raise OperationError(f"{out}: can't be written: {error.strerror}") from error
    if as_json:
        print_json(RigCodesOutput(until=ends.isoformat(), codes=made))
        return
    table = TerminalTable("id", "name", "group", "rig", "code", title=f"codes until {ends:%Y-%m-%d %H:%M}")
    for one in students:
        table.add_row(one.id, one.name, one.group, one.rig or "any", made[one.id])
    TerminalConsole().print(table)


@contextmanager
def _join(config: Path | None) -> "Iterator[tuple[LabConfig, Bus, list[ServiceInfo]]]":
    """Join the bus of a running lab; yield the lab, its bus and its services."""
    from hilrig_cli.client import discover_services
    from hilrig_cli.service_kinds import RIG_SERVICES
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError

    lab = load_lab(config)
    with ZenohBus(lab.bus, "rig") as bus:
        found = discover_services(bus, lab, set(RIG_SERVICES))
        if not found:
            raise OperationError(f"no service of lab {lab.name!r} found: {lab.bus.no_answer_hint}")
        yield lab, bus, found


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


def _settings(infos: "list[ServiceInfo]", rig: str, options: dict[str, Any], settings: Path | None) -> "RigSettings":
    from hilrig_runtime.config.lab import read_rig
    from hilrig_runtime.config.validation import parse_toml, read_text
    from hilrig_runtime.errors import InputError

    if any(rig in info.rigs for info in infos if info.service in ("sim", "edge")):
        raise InputError(f"rig {rig!r} already exists in the lab: choose another name")
    values = {} if settings is None else parse_toml(read_text(settings), str(settings))
    given = {key: value for key, value in options.items() if value is not None}
    return read_rig(json.dumps(values | given | {"name": rig}))


def _least_loaded(infos: "list[ServiceInfo]", service: str, lab: "LabConfig") -> "ServiceInfo":
    from hilrig_runtime.errors import OperationError

    candidates = [info for info in infos if info.service == service]
    if not candidates:
        raise OperationError(f"no {service} service of lab {lab.name!r} found: is it running?")
    return min(candidates, key=lambda info: len(info.rigs))
