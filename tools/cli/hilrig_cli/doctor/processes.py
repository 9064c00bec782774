"""The processes of a lab on this host, from the process table (Linux), and the reachability of the router."""

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import HilrigError
from hilrig_schemas.topics import SERVICES

_PROC: Final = Path("/proc")
_STOPPED: Final = ("T", "t")
_CONNECT_TIMEOUT_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class LocalProcess:
    """A service or the router of a lab that runs on this host."""

    service: str
    """sim, edge, recorder or router."""
    pid: int
    is_stopped: bool
    """It was stopped with a signal (SIGSTOP, Ctrl-Z) or by a debugger: it does nothing until SIGCONT."""
    instance: str = "1"

    @property
    def name(self) -> str:
        """ "<service>/<instance>"."""
        return f"{self.service}/{self.instance}"


class RouterState(Enum):
    """Result of a TCP connection to the router."""

    ACCEPTS = "its port accepts connections, but it does not answer"
    REFUSES = "its host answers, but no program listens on the port"
    UNREACHABLE = "its host does not answer"


def can_list_processes() -> bool:
    """Return whether this system has a process table that `local_processes` can read."""
    return (_PROC / "self/stat").exists()


def local_processes(lab: LabConfig) -> list[LocalProcess]:
    """Return the processes of a lab on this host, in this network namespace; those of other users too."""
    found = []
    for entry in _PROC.glob("[0-9]*"):
        # A process may end meanwhile, and that of another user may hide its details.
        with suppress(OSError, ValueError):
            arguments = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            service, options = _service_of(arguments)
            if service and _is_here(entry) and _is_of_lab(lab, options, entry):
                # The name in parentheses may contain spaces; the state follows it.
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in ("Z", "X"):
                    instance = next(_values_of(options, "--instance"), "1")
                    found.append(LocalProcess(service, int(entry.name), state in _STOPPED, instance))
    return sorted(found, key=lambda one: (one.service, one.pid))


def _service_of(arguments: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Return the service that a command line starts, and its options; empty: it starts none."""
    for number, argument in enumerate(arguments[:4]):
        if Path(argument).name in ("hilrig", "hilrig_cli"):
            options = arguments[number + 1 :]
            return next((name for name in (*SERVICES, "router") if name in options), ""), options
    return "", ()


def _is_here(entry: Path) -> bool:
    try:
        return (entry / "ns/net").readlink() == (_PROC / "self/ns/net").readlink()
    except OSError:
        return True


def _is_of_lab(lab: LabConfig, options: Sequence[str], entry: Path) -> bool:
    path = next(_values_of(options, "-c", "--config"), None)
    try:
        config = load_lab(None if path is None else Path(os.path.join((entry / "cwd").readlink(), path)))  # noqa: PTH118
    except (HilrigError, OSError):
        # Its file is unreadable from here: a process of this lab must not be overlooked.
        return True
    return config.name == lab.name and config.bus == lab.bus


def _values_of(options: Sequence[str], *names: str) -> Iterator[str]:
    for option, value in zip(options, [*options[1:], ""], strict=True):
        if option in names:
            yield value
        elif option.startswith(f"{names[-1]}="):
            yield option.partition("=")[2]


def probe_router(lab: LabConfig) -> RouterState:
    """Open a TCP connection to the router of a lab."""
    port = lab.bus.router.partition("?")[0].rpartition(":")[2]
    try:
        with socket.create_connection((lab.bus.router_host, int(port)), _CONNECT_TIMEOUT_S):
            return RouterState.ACCEPTS
    except ConnectionRefusedError:
        return RouterState.REFUSES
    except (OSError, ValueError):
        return RouterState.UNREACHABLE
