"""`hilrig events`: prints the events of a recording, or of a running lab as they happen."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hilrig_schemas import Event

SEVERITIES = ("info", "warning", "error")


def events(
    run: Annotated[
        Path | None, typer.Argument(metavar="RUN.MCAP", help="A recording; without one, the events of a running lab.")
    ] = None,
    rig: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this rig; may be repeated.")] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND", help="Only this kind, for example watchdog-trip; may be repeated."),
    ] = None,
    severity: Annotated[
        Literal["info", "warning", "error"], typer.Option(help="Only events of this severity or above.")
    ] = "info",
    config: Config = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")] = False,
) -> None:
    """Print the events of a recording; or follow those of a running lab until Ctrl-C.

    An event has its time, severity, rig (or service), kind and a sentence.
    """
    from hilrig_cli.json_output.lab import EventsOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.escaping import printable
    from hilrig_schemas import Event

    kinds = {name.lower().replace("_", "-") for name in kind or ()}
    known = {_kind_text(name) for name, _ in Event.Kind.items() if not name.startswith("KIND_")}
    if unknown := sorted(kinds - known):
        raise InputError(f"--kind {unknown[0]}: no such kind of event; expected one of {', '.join(sorted(known))}")
    if run is not None and config is not None:
        raise InputError("a recording and --config can't be combined: give the recording, or the lab to follow")
    lowest = SEVERITIES.index(severity)
    for event in _recorded(run) if run is not None else _live(config, rig or []):
        if (
            (not kinds or _kind_text(_name(Event.Kind, event.kind)) in kinds)
            and (not rig or event.rig in rig)
            and event.severity > lowest
        ):
            if as_json:
                print_json(EventsOutput.model_validate(_row(event)))
            else:
                print(printable(_line(event)), flush=True)


def _recorded(path: Path) -> "Iterator[Event]":
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_run
    from hilrig_replay.io.run import open_run

    with isolated(path):
        yield from open_run(find_run(path)).events["message"]


def _live(config: Path | None, rigs: list[str]) -> "Iterator[Event]":
    from queue import Empty, SimpleQueue

    from google.protobuf.message import DecodeError

    from hilrig_cli.client import check_rig, discover_services
    from hilrig_cli.options import log
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import OperationError
    from hilrig_runtime.process.shutdown import stop_on_signals
    from hilrig_schemas.topics import EVENT

    lab = load_lab(config)
    received: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    stopping = stop_on_signals()
    with ZenohBus(lab.bus, "tool") as bus:
        if not discover_services(bus, lab, {"edge"}):
            raise OperationError(f"no service of lab {lab.name!r} found: {lab.bus.no_answer_hint}")
        for name in rigs:
            check_rig(bus, lab, name)
        handle = bus.subscribe(EVENT.key(lab.name, "*"), lambda key, payload: received.put((key, payload)))
        log(f"following the events of lab {lab.name!r}; press Ctrl-C to stop")
        while not stopping.is_set():
            try:
                key, payload = received.get(timeout=0.2)
                yield EVENT.decode_from(key, payload)
            except Empty:
                continue
            except DecodeError:
                log(f"{key}: an event can't be decoded; the sender runs another version of hilrig")
        handle.close()


def _kind_text(name: str) -> str:
    return name.lower().replace("_", "-")


def _name(enum: object, number: int) -> str:
    """Name of an enumerator; the number, if a later version sent it."""
    try:
        return enum.Name(number)  # type: ignore[attr-defined, no-any-return]
    except ValueError:
        return str(number)


def _row(event: "Event") -> dict[str, object]:
    from hilrig_schemas import Event

    return {
        "time": event.wall_ns / 1e9,
        "rig": event.rig,
        "source": event.source,
        "kind": _kind_text(_name(Event.Kind, event.kind)),
        "severity": _name(Event.Severity, event.severity).lower(),
        "session": event.session,
        "step": event.step,
        "text": event.text,
    }


def _line(event: "Event") -> str:
    from datetime import datetime

    row = _row(event)
    try:
        at = datetime.fromtimestamp(event.wall_ns / 1e9).astimezone().isoformat(sep=" ", timespec="milliseconds")[:23]
    except (ValueError, OverflowError, OSError):
        at = f"{event.wall_ns} ns"
    return f"{at} {row['severity']:7} {event.rig or event.source}: {row['kind']}: {event.text}"
