"""`hilrig check`: validates a lab's configuration file."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def check(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="LAB.TOML", help="Configuration file of the lab; default: default settings."),
    ] = None,
    template: Annotated[
        bool, typer.Option("--template", help="Print a template with every key, its meaning and its default instead.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Validate a lab's configuration file and roster: report every error, and print the rigs with their addresses."""

    from hilrig_cli.json_output.lab import CheckOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_runtime.addresses import format_address
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.config.template import lab_template
    from hilrig_runtime.escaping import printable
    from hilrig_sim.accuracy import accuracy_warnings
    from hilrig_sim.arm.model import describe_substeps
    from hilrig_sim.parameters import lab_parameters

    if template:
        print(lab_template(), end="")
        return
    lab = load_lab(file)
    rigs = lab_parameters(lab, str(file or "defaults"))
    roster = None if lab.classroom is None else lab.classroom.students([rig.name for rig in lab.rigs])
    if as_json:
        found = {"ports": lab.ports, "tls_ports": lab.tls_ports, "warnings": list(accuracy_warnings(rigs))}
        print_json(CheckOutput.model_validate(dict(lab) | found))
        return
    addresses = lab.addresses()
    is_restricted = any(rig.allow for rig in lab.rigs)
    columns = ("rig", *addresses[lab.rigs[0].name], *(["allowed networks"] if is_restricted else []))
    title = f"{file or 'defaults'}: lab {lab.name!r} is valid"
    table = TerminalTable(*columns, "step", "integrator", title=title)
    for rig in lab.rigs:
        substeps = "" if lab.sim.substeps == 1 else f", {describe_substeps(lab.sim.substeps)}"
        allowed = [", ".join(map(str, rig.allow)) or "all"] if is_restricted else []
        step = (f"{lab.sim.step_ms:g} ms", lab.sim.integrator + substeps)
        table.add_row(rig.name, *(format_address(*one) for one in addresses[rig.name].values()), *allowed, *step)
    TerminalConsole().print(table)
    for rig in lab.rigs:
        if rig.controller is not None:
            print(f"{rig.name}: {rig.describe_controller()}")
    if roster is not None and lab.classroom is not None:
        how = "fixed by the roster" if lab.classroom.claims is None else "claimed with codes (hilrig rig codes)"
        print(f"{printable(str(lab.classroom.roster))}: {len(roster.students)} students; rigs are {how}")
    for warning in accuracy_warnings(rigs):
        print(f"warning: {warning}", file=sys.stderr)
