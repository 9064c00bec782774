"""`hilrig doctor`: diagnosis of a deployment."""

from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from collections.abc import Collection

    from hilrig_cli.doctor import CheckResult
    from hilrig_runtime.config.lab import LabConfig


_SERVICE_FIX = "run hilrig doctor on its host: it tells a stopped process, a dead one and a cut link apart"


def doctor(
    config: Config = None,
    service: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Check this service only (sim, edge, recorder or router); for container health checks.",
        ),
    ] = "",
    instance: Annotated[
        str,
        typer.Option(metavar="NAME", help="With --service: check this instance; default: any."),
    ] = "",
    here: Annotated[
        str,
        typer.Option(
            metavar="KIND,KIND…",
            help="Services that this host should run, such as sim,edge; default: of a lab on several hosts, what its "
            "processes, addresses, certificates and the bus show.",
        ),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Check ports, bus, services, controllers, certificates, versions, clocks, limits, disk; print how to fix errors.

    Run it on each host, before or while the lab runs. A host is checked for the services that it should run: ports,
    open files and controllers for the edge, the disk for the recorder, punctuality for simulation and edge. Exit code
    1: at least one error was found.
    """
    from hilrig_cli.doctor import Level
    from hilrig_cli.doctor.host_services import parse_kinds
    from hilrig_cli.json_output.lab import DoctorOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_runtime.config.lab import load_lab

    lab = load_lab(config)
    results = _check_service(lab, service, instance) if service else _check_all(lab, parse_kinds(here))
    errors = [result for result in results if result.level is Level.ERROR]
    if as_json:
        print_json(DoctorOutput(lab=lab.name, well=not errors, findings=results))
    else:
        _print_table(results)
    if errors:
        raise typer.Exit(1)


def _check_all(lab: "LabConfig", chosen: "Collection[str]") -> "list[CheckResult]":
    from importlib.metadata import version

    from hilrig_cli.doctor import CheckResult, host, host_services, processes, services

    text = f"{lab.name!r}: {len(lab.rigs)} rig{'s' * (len(lab.rigs) > 1)}, step {lab.sim.step_ms:g} ms"
    results = [CheckResult.ok("lab", text)]
    results += host.check_software()
    local = processes.local_processes(lab)
    bus_results, joined = services.check_bus(lab, local)
    results += bus_results
    if joined is not None:
        results += services.check_services(lab, joined, local)
    # Without the bus the services are unknown; the checks of this host still run.
    snapshot = joined or services.BusSnapshot()
    elsewhere = host_services.services_elsewhere(lab, snapshot, local, chosen)
    results += host_services.check_here(elsewhere, local, chosen)
    is_timed = not {"sim", "edge"} <= set(elsewhere)
    if is_timed or snapshot.healths:
        results += services.check_realtime(lab, snapshot)
    results += services.check_versions(snapshot.healths.values(), version("hilrig"))
    results += services.check_clocks(snapshot.clocks)
    if lab.bus.tls is not None or lab.edge.tls is not None:
        results += _check_certificates(lab)
    if "edge" not in elsewhere:
        is_edge_stopped = any(one.service == "edge" and one.is_stopped for one in local)
        results += host.check_ports(lab, snapshot.services, is_edge_stopped=is_edge_stopped)
        if any(rig.controller is not None for rig in lab.rigs):
            results += _check_controllers(lab, snapshot.services)
        results += host.check_open_files(lab)
    if is_timed:
        results += host.check_timer_accuracy(lab)
    if "recorder" not in elsewhere:
        results += host.check_disk(lab)
    return results


def _check_certificates(lab: "LabConfig") -> "list[CheckResult]":
    from datetime import UTC, datetime

    from hilrig_cli.doctor.certificates import check_certificates

    return list(check_certificates(lab, datetime.now(UTC)))


def _check_controllers(lab: "LabConfig", running: "Collection[str]") -> "list[CheckResult]":
    from hilrig_cli.doctor import CheckResult
    from hilrig_runtime.errors import install_command

    try:
        from hilrig_cli.doctor.controllers import check_controllers
    except ModuleNotFoundError as error:
        text = f"not tested: {error.name!r} is not installed on this host"
        fix = f"in hilrig's folder: {install_command('rig')}, or run hilrig doctor on the edge's host"
        return [CheckResult.warning("controllers", text, fix)]
    return list(check_controllers(lab, running))


def _check_service(lab: "LabConfig", service: str, instance: str) -> "list[CheckResult]":
    from hilrig_cli.doctor import CheckResult
    from hilrig_cli.doctor.services import collect, matches
    from hilrig_runtime.errors import HilrigError, InputError
    from hilrig_schemas.topics import SERVICES

    if service not in (*SERVICES, "router"):
        raise InputError(f"--service {service}: expected sim, edge, recorder or router")
    if service == "router" and lab.bus.topology != "router":
        raise InputError('--service router: this lab has no router (bus.topology in lab.toml is not "router")')
    # A container has its own service's certificate only. In a mesh the service's port is in use, so join as a tool.
    identity = service if lab.bus.topology == "router" else "tool"
    wanted = f"{service}/{instance}" if instance else service
    try:
        snapshot = collect(lab, identity, until=wanted, timeout_s=0.0 if service == "router" else 2.5)
    except HilrigError as error:
        return [CheckResult.error(service, str(error), "see the service's log")]
    if service == "router":
        return [CheckResult.ok(service, "running")]
    for name, health in snapshot.healths.items():
        if matches(name, wanted):
            if health.alert:
                return [CheckResult.error(service, health.alert, "see the service's log")]
            return [CheckResult.ok(service, f"{name}: running for {health.uptime_ns / 1e9:.0f} s")]
    return [CheckResult.error(service, f"no health report from {wanted}", _SERVICE_FIX)]


def _print_table(results: "list[CheckResult]") -> None:
    from rich.markup import escape

    from hilrig_cli.doctor import Level
    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    colors = {Level.OK: "green", Level.WARNING: "yellow", Level.ERROR: "bold red"}
    table = TerminalTable()
    for column in ("level", "check", "result"):
        table.add_column(column, no_wrap=column != "result", overflow="fold")
    for result in results:
        fix = f"\n[dim]fix: {escape(result.fix)}[/dim]" if result.fix else ""
        table.add_row(f"[{colors[result.level]}]{result.level.value}[/]", result.check, escape(result.text) + fix)
    console = TerminalConsole(markup=True)
    console.print(table)
    errors = sum(result.level is Level.ERROR for result in results)
    warnings = sum(result.level is Level.WARNING for result in results)
    summary = _count(errors, "error") + (f", {_count(warnings, 'warning')}" if warnings else "")
    console.print(f"[bold red]{summary}[/]" if errors else f"[green]{summary}[/]", highlight=False)


def _count(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"
