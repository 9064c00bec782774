"""`hilrig lease`: shows or releases the lease of a rig."""

from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AllRigs, AsJson, Config, check_rigs

if TYPE_CHECKING:
    from hilrig_schemas import LeaseStatus


def lease(
    rigs: Annotated[
        list[str] | None, typer.Argument(metavar="RIG", help="Names of the rigs; default: all rigs of the lab.")
    ] = None,
    every: AllRigs = False,
    release: Annotated[bool, typer.Option("--release", help="Revoke the lease of the current lease holder.")] = False,
    end_claim: Annotated[bool, typer.Option("--end-claim", help="End the claim of the rig by a student.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Show the lease holder and the student of each rig, or revoke leases or claims.

    After --release the next other controller that writes acquires the rig. After --end-claim it must be claimed again,
    with this or another code. Exit code 1: a rig had no lease holder, or was not claimed.
    """
    from hilrig_cli.client import query_edges
    from hilrig_cli.json_output.lab import LeaseOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_runtime.config.lab import load_lab
    from hilrig_schemas import LeaseRequest, topics

    if release or end_claim:
        check_rigs(rigs, every, f"hilrig lease {'--release' if release else '--end-claim'}")
    request = LeaseRequest(release=release, end_claim=end_claim)
    statuses = query_edges(load_lab(config), topics.LEASE, rigs or [], request)
    if as_json:
        rows = [LeaseOutput.model_validate(_row(status)) for status in statuses]
        print_json(rows[0] if len(rigs or []) == 1 else rows)
    else:
        _print_table(statuses, release, end_claim)
    done = [(not release or status.released) and (not end_claim or status.claim_ended) for status in statuses]
    if not all(done):
        raise typer.Exit(1)


def _row(status: "LeaseStatus") -> dict[str, object]:
    return {
        "rig": status.rig,
        "holder": status.holder,
        "released": status.released,
        "silent_s": status.silent_ns / 1e9,
        "session": status.session,
        "connections": status.connections,
        "watchdog_tripped": status.watchdog_tripped,
        "watchdog_timeout_ms": status.watchdog_timeout_ns / 1e6,
        "client_of": status.client_of,
        "controller_fault": status.controller_fault,
        "skipped_states": status.skipped_states,
        "student": status.student,
        "claimed_from": status.claimed_from,
        "claim_ended": status.claim_ended,
    }


def _print_table(statuses: "list[LeaseStatus]", release: bool, end_claim: bool) -> None:

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    table = TerminalTable()
    student = ["student"] if any(status.student for status in statuses) else []
    for column in ("rig", *student, "lease holder", "silent", "session", "clients", "watchdog"):
        table.add_column(column, no_wrap=column in ("rig", "watchdog"), overflow="fold")
    for status in statuses:
        timeout = "off" if not status.watchdog_timeout_ns else f"{status.watchdog_timeout_ns / 1e6:g} ms"
        holder = f"client of {status.client_of}" if status.client_of else status.holder or "none"
        table.add_row(
            status.rig,
            *([_student(status)] if student else []),
            f"{holder}: {status.controller_fault}" if status.controller_fault else holder,
            f"{status.silent_ns / 1e9:.1f} s" if status.holder else "",
            status.session,
            str(status.connections),
            "tripped" if status.watchdog_tripped else timeout,
        )
    console = TerminalConsole()
    console.print(table)
    if release:
        for status in statuses:
            revoked = f"lease of {status.released} revoked: the next other controller that writes acquires it"
            console.print(f"{status.rig}: {revoked if status.released else 'it had no lease holder'}")
    if end_claim:
        for status in statuses:
            ended = f"claim of {status.claim_ended} ended: it must be claimed again"
            console.print(f"{status.rig}: {ended if status.claim_ended else 'it was not claimed'}")


def _student(status: "LeaseStatus") -> str:
    return f"{status.student} from {status.claimed_from}" if status.claimed_from else status.student or "none"
