"""Supervisor of a host's services: starts them as child processes, restarts them, and stops them in order.

Children are spawned, never forked, each in its own process group, so that Ctrl-C reaches the supervisor only and the
stop order is kept (see `service_kinds.STOP_ORDER`). A child stops when its standard input is closed, which also happens
when the supervisor dies.
"""

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hilrig_cli.service_kinds import STOP_ORDER
from hilrig_runtime.bus.api import Handle
from hilrig_runtime.errors import HilrigError, InputError, OperationError
from hilrig_schemas.topics import SERVICES

STOP_TIMEOUT_S: Final = 2.4
"""Time for all children to stop before they are killed; below the 3 s in which `hilrig up` must end."""
MIN_BACKOFF_S: Final = 0.1
MAX_BACKOFF_S: Final = 5.0
STABLE_AFTER_S: Final = 10.0
"""Uptime after which the restart delay is reset; a child that dies earlier doubles it each time."""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """Specification of one process of a lab."""

    service: str
    instance: str = "1"
    rigs: tuple[str, ...] = ()
    """Rigs that it serves; empty: all rigs of the lab."""

    @property
    def name(self) -> str:
        """Display name."""
        return self.service if self.instance == "1" else f"{self.service} {self.instance}"

    @property
    def options(self) -> list[str]:
        """Command and options that start the service."""
        rigs = ["--rigs", ",".join(self.rigs)] if self.rigs else []
        return [self.service, "--instance", self.instance, *rigs]


DEFAULT_PROCESSES: Final = tuple(ProcessSpec(service) for service in SERVICES)
"""One process for each kind of service."""


def lab_processes(rigs: Sequence[str], *, edges: int = 1, recorders: int = 1) -> tuple[ProcessSpec, ...]:
    """Processes of a lab whose rigs are divided among several edges and recorders, in contiguous ranges.

    Raises:
        InputError: there are more processes than rigs.
    """
    processes = [ProcessSpec("sim")]
    for service, count in (("edge", edges), ("recorder", recorders)):
        if not 1 <= count <= len(rigs):
            raise InputError(f"--{service}s {count}: expected 1 to {len(rigs)}, the number of rigs")
        for number in range(count):
            own_rigs = rigs[number * len(rigs) // count : (number + 1) * len(rigs) // count]
            processes.append(ProcessSpec(service, str(number + 1), tuple(own_rigs) if count > 1 else ()))
    return tuple(processes)


@dataclass
class _Child:
    spec: ProcessSpec
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    backoff_s: float = MIN_BACKOFF_S
    restart_at_s: float | None = None


class Supervisor(Handle):
    """Runs the services of a lab; `log` receives a line for each change. Closing it stops every child."""

    def __init__(
        self,
        config: Path | None,
        log: Callable[[str], None],
        processes: Sequence[ProcessSpec] = DEFAULT_PROCESSES,
        options: Sequence[str] = (),
    ) -> None:
        self._config = config
        self._log = log
        self._options = tuple(options)
        self._children = {spec.name: _Child(spec) for spec in processes}
        self._ready = False

    @property
    def pids(self) -> Mapping[str, int]:
        """Process id of each running child, by its display name."""
        return {name: child.process.pid for name, child in self._children.items() if child.process is not None}

    def start(self) -> None:
        """Start every child."""
        for child in self._children.values():
            self._spawn(child)

    def mark_ready(self) -> None:
        """Mark the lab as ready: from now on a child that dies is restarted, whatever its exit code."""
        self._ready = True

    def poll(self) -> None:
        """Check the children and restart those that died; call it about ten times a second.

        Raises:
            HilrigError: a child ended before the lab was ready; its reason is on standard error.
        """
        now_s = time.monotonic()
        for child in self._children.values():
            if child.process is not None and (code := child.process.poll()) is not None:
                self._on_death(child, code, now_s)
            elif child.process is None and child.restart_at_s is not None and now_s >= child.restart_at_s:
                self._spawn(child)
                self._log(f"{child.spec.name} restarted")

    def reload(self) -> None:
        """Make every child read its configuration again; may be called from any thread."""
        for child in self._children.values():
            process = child.process
            if process is not None and hasattr(signal, "SIGHUP"):
                process.send_signal(signal.SIGHUP)

    def close(self) -> None:
        """Stop the children in order; kill those that do not stop in time."""
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        for service in STOP_ORDER:
            stopping = [child for child in self._children.values() if child.spec.service == service]
            # Children of one kind stop in parallel.
            for child in stopping:
                _close_stdin(child.process)
            for child in stopping:
                process, child.process = child.process, None
                if process is not None:
                    try:
                        process.wait(timeout=max(0.1, deadline_s - time.monotonic()))
                    except subprocess.TimeoutExpired:
                        self._log(f"{child.spec.name} did not stop in time; killing it")
                        process.kill()
                        process.wait()

    def _spawn(self, child: _Child) -> None:
        command = [sys.executable, "-m", "hilrig_cli", *child.spec.options, *self._options, "--stop-with-parent"]
        if self._config is not None:
            command += ["--config", str(self._config)]
        child.process = subprocess.Popen(command, stdin=subprocess.PIPE, **own_process_group())
        child.started_s = time.monotonic()
        child.restart_at_s = None

    def _on_death(self, child: _Child, code: int, now_s: float) -> None:
        _close_stdin(child.process)
        child.process = None
        if not self._ready:
            failure: type[HilrigError] = InputError if code == InputError.exit_code else OperationError
            raise failure(f"the {child.spec.name} service {_describe_exit(code)} before the lab was up")
        if now_s - child.started_s > STABLE_AFTER_S:
            child.backoff_s = MIN_BACKOFF_S
        child.restart_at_s = now_s + child.backoff_s
        child.backoff_s = min(MAX_BACKOFF_S, 2 * child.backoff_s)
        self._log(f"{child.spec.name} {_describe_exit(code)}; restarting it")


def own_process_group() -> dict[str, Any]:
    """Arguments of `Popen` that start a child in its own process group, so that Ctrl-C does not reach it."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def _close_stdin(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None and process.stdin is not None:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()


def _describe_exit(code: int) -> str:
    return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
