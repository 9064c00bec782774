"""`hilrig doctor`: is this deployment as it should be, and what is to be mended?"""

import json
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from datetime import datetime

    from hilrig_cli.doctor import Finding
    from hilrig_runtime.config.lab import LabConfig


def doctor(
    config: Config = None,
    service: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Only ask whether this service is well (sim, edge, recorder or router), as health checks do.",
            show_default=False,
        ),
    ] = "",
    instance: Annotated[
        str,
        typer.Option(metavar="NAME", help="With --service: this one of its kind; without: any.", show_default=False),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Look at ports, bus, services, certificates, versions, clocks, limits and disk, and say what is to be mended.

    Run it on each host, before or while the lab runs. Exit code 1 if something is wrong.
    """
    from hilrig_runtime.config.lab import load_lab

    lab = load_lab(config)
    findings = _one_service(lab, service, instance) if service else _everything(lab)
    bad = [finding for finding in findings if finding.level.value == "wrong"]
    if as_json:
        rows = [
            {"check": found.check, "level": found.level.value, "text": found.text, "mend": found.mend}
            for found in findings
        ]
        print(json.dumps({"lab": lab.name, "well": not bad, "findings": rows}))
    else:
        _print(findings)
    if bad:
        raise typer.Exit(1)


def _everything(lab: "LabConfig") -> "list[Finding]":
    from datetime import UTC, datetime
    from importlib.metadata import version

    from hilrig_cli.doctor import good, host
    from hilrig_cli.doctor import services as on_bus

    findings = [
        good("lab", f"{lab.name!r}: {len(lab.rigs)} rig{'s' * (len(lab.rigs) > 1)}, step {lab.sim.step_ms:g} ms")
    ]
    findings += host.check_software()
    of_bus, heard = on_bus.check_bus(lab)
    findings += of_bus
    if heard is not None:
        findings += on_bus.check_services(lab, heard)
    # Of a lab that can't be heard nobody knows what runs; this host can be looked at all the same.
    heard = heard or on_bus.Heard()
    findings += on_bus.check_realtime(lab, heard)
    findings += on_bus.check_versions((health for health, _ in heard.healths.values()), version("hilrig"))
    findings += on_bus.check_clocks(list(heard.healths.values()))
    if lab.bus.tls is not None or lab.edge.tls is not None:
        findings += _certificates(lab, datetime.now(UTC))
    findings += host.check_ports(lab, heard.services)
    findings += host.check_open_files(lab)
    findings += host.check_punctuality(lab)
    findings += host.check_disk(lab)
    return findings


def _certificates(lab: "LabConfig", now: "datetime") -> "list[Finding]":
    from hilrig_cli.doctor import notice

    try:
        # Only the edge needs what reads certificates; zenoh reads its own.
        from hilrig_cli.doctor.certificates import check_certificates
    except ModuleNotFoundError as error:
        text = f"can't be looked at: {error.name!r} is not installed on this host"
        return [notice("certificates", text, "pip install 'hilrig[edge]', or look at copies of them elsewhere")]
    return list(check_certificates(lab, now))


def _one_service(lab: "LabConfig", service: str, instance: str) -> "list[Finding]":
    from hilrig_cli.doctor import good, wrong
    from hilrig_cli.doctor.services import SERVICES, is_one, listen
    from hilrig_runtime.errors import HilrigError, InputError

    if service not in (*SERVICES, "router"):
        raise InputError(f"--service {service}: expected sim, edge, recorder or router")
    if service == "router" and lab.bus.topology != "router":
        raise InputError("--service router: this lab has none (bus.topology in lab.toml)")
    # A container has its own service's certificate and no other; in a mesh a tool's is needed, for the port is taken.
    identity = service if lab.bus.topology == "router" else "tool"
    wanted = f"{service}/{instance}" if instance else service
    try:
        heard = listen(lab, identity, until=wanted, for_s=0.0 if service == "router" else 2.5)
    except HilrigError as error:
        return [wrong(service, str(error), "see its log")]
    if service == "router":
        return [good(service, "it answers")]
    for name, (health, _) in heard.healths.items():
        if is_one(name, wanted):
            if health.alert:
                return [wrong(service, health.alert, "see its log")]
            return [good(service, f"{name} is well, {health.uptime_ns / 1e9:.0f} s after it started")]
    return [wrong(service, f"no {wanted} says how it is", "see its log, or start it again")]


def _print(findings: "list[Finding]") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    colours = {"good": "green", "notice": "yellow", "wrong": "bold red"}
    table = Table()
    for column in ("", "check", "found"):
        table.add_column(column, no_wrap=column != "found", overflow="fold")
    for found in findings:
        mend = f"\n[dim]→ {escape(found.mend)}[/dim]" if found.mend else ""
        level = found.level.value
        table.add_row(f"[{colours[level]}]{level}[/]", found.check, escape(found.text) + mend)
    Console().print(table)
    wrong = sum(found.level.value == "wrong" for found in findings)
    notices = sum(found.level.value == "notice" for found in findings)
    well = "all is well" if not notices else f"nothing is wrong; {notices} to look at"
    Console().print(f"[green]{well}[/]" if not wrong else f"[bold red]{wrong} to mend[/]")
