"""The files of one session: how they are called, and what the next must know of those before.

`<session>.mcap`; when a session needs another file (the recorder was restarted, the file grew too large, the disk was
full for a while) the next is `<session>.2.mcap`, and its metadata names the one before.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL
from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, PART_SUFFIX, part_path
from hilrig_recorder.mcap_format.recover import Tail, read_tail
from hilrig_runtime.errors import InputError


@dataclass(frozen=True, slots=True)
class NextPart:
    """Where a session goes on."""

    path: Path
    number: int
    """Which file of the session it is, from 1."""
    previous: Path | None
    """The one before; None: this is the first."""


def next_part(folder: Path, session: str, after: str = "") -> NextPart:
    """The file after the last of a session, whole or unfinished, and behind the file of the name `after`.

    Those before may be deleted or moved away already.

    Raises:
        OSError: the folder can't be looked into.
    """
    try:
        names = [path.name for path in folder.iterdir()]
    except FileNotFoundError:
        # Not there yet.
        names = []
    number = max(_number(name, session) for name in (*names, after))
    previous = folder / file_name(session, number) if number else None
    return NextPart(folder / file_name(session, number + 1), number + 1, previous)


def tail_of_session(folder: Path, session: str, number: int, tail_ns: int) -> Tail:
    """The last `tail_ns` of a session's files up to a number: a recorder may have been restarted often."""
    tail = _tail(folder / file_name(session, number), tail_ns)
    last_ns = tail.last_ns
    while number > 1 and (not last_ns or last_ns - tail.last_ns < tail_ns):
        number -= 1
        before = _tail(folder / file_name(session, number), tail_ns)
        last_ns = last_ns or before.last_ns
        reached_ns = before.last_ns or tail.last_ns
        tail = Tail(tail.end, tail.keys | before.keys, {**before.last, **tail.last}, reached_ns)
    return tail


def horizon_of(tail: Tail) -> dict[int, int]:
    """Of each channel the publish time before which `tail` does not know what was recorded.

    A channel is recorded in order. Events have several senders, whose clocks may differ; for them, and for a channel of
    which nothing was seen, it is the earliest of all.
    """
    earliest = min((publish_ns for _, _, publish_ns in tail.keys), default=0)
    horizon_ns = dict.fromkeys(CHANNEL_OF_TOPIC.values(), 0)
    for channel_id, _, publish_ns in tail.keys:
        horizon_ns[channel_id] = min(horizon_ns[channel_id] or publish_ns, publish_ns)
    horizon_ns[EVENT_CHANNEL] = 0
    return {channel_id: publish_ns or earliest for channel_id, publish_ns in horizon_ns.items()}


def file_name(session: str, number: int) -> str:
    """Name of a session's file; `number` counts from 1."""
    return f"{session}{MCAP_SUFFIX}" if number == 1 else f"{session}.{number}{MCAP_SUFFIX}"


def _number(name: str, session: str) -> int:
    """Which file of a session is called so; 0: none."""
    stem = name.removesuffix(PART_SUFFIX).removesuffix(MCAP_SUFFIX)
    if stem == session:
        return 1
    number = stem.removeprefix(f"{session}.")
    return int(number) if number.isdecimal() and number != stem else 0


def _tail(path: Path, tail_ns: int) -> Tail:
    # It may get its name just now, from the disk's thread or because it is recovered.
    for candidate in (path, part_path(path), path):
        with contextlib.suppress(InputError):
            return read_tail(candidate, tail_ns)
    return Tail("", set(), {}, 0)
