"""The services of one host as child processes: started together, restarted when they die, ended in order.

Children are spawned, never forked, each in a process group of its own, so that Ctrl-C reaches this process alone and
the order of ending stays ours: the edge first (it zeroes the torques and ends the sessions), the recorder last (it
still hears of that). The wish to end is told by closing the child's standard input, which also tells it when this
process dies.
"""

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from hilrig_runtime.errors import HilrigError, InputError, OperationError

START_ORDER: Final = ("sim", "edge", "recorder")
STOP_ORDER: Final = ("edge", "sim", "recorder")
STOP_TIMEOUT_S: Final = 2.4
"""All children together; then they are killed. With the rest it stays below the 3 s that a user waits for."""
FIRST_BACKOFF_S: Final = 0.1
LONGEST_BACKOFF_S: Final = 5.0
SETTLED_S: Final = 10.0
"""A child that lived so long is restarted at once when it dies; before, the pause doubles each time."""


@dataclass(frozen=True, slots=True)
class Part:
    """One process of a lab."""

    service: str
    instance: str = "1"
    rigs: tuple[str, ...] = ()
    """Those that it serves; none named: all of the lab."""

    @property
    def name(self) -> str:
        """What it is called to people."""
        return self.service if self.instance == "1" else f"{self.service} {self.instance}"

    @property
    def options(self) -> list[str]:
        """How the command line of its service says it."""
        rigs = ["--rigs", ",".join(self.rigs)] if self.rigs else []
        return [self.service, "--instance", self.instance, *rigs]


WHOLE_LAB: Final = tuple(Part(service) for service in START_ORDER)


def shared(rigs: Sequence[str], *, edges: int = 1, recorders: int = 1) -> tuple[Part, ...]:
    """The processes of a lab whose rigs are shared out among several edges and recorders, each a run of neighbours.

    Raises:
        InputError: there are more processes than rigs.
    """
    parts = [Part("sim")]
    for service, count in (("edge", edges), ("recorder", recorders)):
        if not 1 <= count <= len(rigs):
            raise InputError(f"--{service}s {count}: expected 1 to {len(rigs)}, the number of rigs")
        for number in range(count):
            mine = rigs[number * len(rigs) // count : (number + 1) * len(rigs) // count]
            parts.append(Part(service, str(number + 1), tuple(mine) if count > 1 else ()))
    return tuple(parts)


@dataclass
class _Child:
    part: Part
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    backoff_s: float = FIRST_BACKOFF_S
    restart_at_s: float | None = None
    restarts: int = 0


class Supervisor:
    """Runs the services of a lab; `say` gets a line for people whenever something changes.

    Use it as a context manager: leaving it ends every child.
    """

    def __init__(
        self,
        config: Path | None,
        say: Callable[[str], None],
        parts: Sequence[Part] = WHOLE_LAB,
        options: Sequence[str] = (),
    ) -> None:
        self._config = config
        self._say = say
        self._options = tuple(options)
        self._children = {part.name: _Child(part) for part in parts}
        self._ready = False

    @property
    def pids(self) -> Mapping[str, int]:
        """Process id of each child that runs, by its part's name."""
        return {name: child.process.pid for name, child in self._children.items() if child.process is not None}

    def start(self) -> None:
        """Start every child."""
        for child in self._children.values():
            self._spawn(child)

    def settled(self) -> None:
        """Say that the lab is up: from now on a child that dies is restarted, whatever its exit code says."""
        self._ready = True

    def poll(self) -> None:
        """Look after the children; call it some ten times a second.

        Raises:
            HilrigError: before the lab was up, a child ended by itself; it said why on standard error.
        """
        now_s = time.monotonic()
        for child in self._children.values():
            if child.process is not None and (code := child.process.poll()) is not None:
                self._on_death(child, code, now_s)
            elif child.process is None and child.restart_at_s is not None and now_s >= child.restart_at_s:
                self._spawn(child)
                child.restarts += 1
                self._say(f"{child.part.name} is started again")

    def close(self) -> None:
        """End the children in order; those that don't end in time are killed."""
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        for service in STOP_ORDER:
            ending = [child for child in self._children.values() if child.part.service == service and child.process]
            # Those of a kind end side by side.
            for child in ending:
                assert child.process is not None
                _close_stdin(child.process)
            for child in ending:
                assert child.process is not None
                try:
                    child.process.wait(timeout=max(0.1, deadline_s - time.monotonic()))
                except subprocess.TimeoutExpired:
                    self._say(f"{child.part.name} did not end in time and is killed")
                    child.process.kill()
                    child.process.wait()
                child.process = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _spawn(self, child: _Child) -> None:
        command = [sys.executable, "-m", "hilrig_cli", *child.part.options, *self._options, "--stop-with-parent"]
        if self._config is not None:
            command += ["--config", str(self._config)]
        child.process = subprocess.Popen(command, stdin=subprocess.PIPE, **own_process_group())
        child.started_s = time.monotonic()
        child.restart_at_s = None

    def _on_death(self, child: _Child, code: int, now_s: float) -> None:
        if child.process is not None:
            _close_stdin(child.process)
        child.process = None
        if not self._ready:
            failure: type[HilrigError] = InputError if code == InputError.exit_code else OperationError
            raise failure(f"the {child.part.name} service {_how_it_ended(code)} before the lab was up")
        if now_s - child.started_s > SETTLED_S:
            child.backoff_s = FIRST_BACKOFF_S
        child.restart_at_s = now_s + child.backoff_s
        child.backoff_s = min(LONGEST_BACKOFF_S, 2 * child.backoff_s)
        self._say(f"{child.part.name} {_how_it_ended(code)}; restarting it")


def own_process_group() -> dict[str, Any]:
    """Arguments of `Popen` that keep a terminal's Ctrl-C away from a child."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def _close_stdin(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()


def _how_it_ended(code: int) -> str:
    return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
