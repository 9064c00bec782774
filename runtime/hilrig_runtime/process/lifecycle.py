"""Runs a service as a process: scheduling policy, signals, bus connection, shutdown."""

import contextlib
import logging
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from hilrig_runtime.bus.api import Bus
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.service import Service
from hilrig_runtime.process.shutdown import CLOSE_TIMEOUT_S, call_on_hangup, force_exit_after, stop_on_signals
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime, lower_priority, set_short_slice

ROUTER_RETRY_S: Final = 0.5
DEFAULT_OPEN_FILES: Final = 1024
"""Limit of open files on systems that do not report one."""

logger = logging.getLogger(__name__)


def run_service(
    name: str,
    run: Callable[[Service], None],
    lab: LabConfig,
    *,
    instance: str = "1",
    rigs: Sequence[str] | None = None,
    stop_with_parent: bool = False,
    close_timeout_s: float = CLOSE_TIMEOUT_S,
) -> None:
    """Open the bus, run a service until it is stopped, and close everything.

    Raises:
        HilrigError: the service can't start or can't continue; everything it opened is closed.
    """
    _set_scheduling(name, lab)
    allow_open_files()
    stopping = stop_on_signals(stop_with_parent=stop_with_parent)
    force_exit_after(stopping, close_timeout_s)
    running: list[Service] = []

    def reload() -> None:
        for service in running:
            service.reload()

    call_on_hangup(reload, stopping)
    bus = _open_bus(lab, name, instance, stopping)
    if bus is None:
        return
    with Service(name, lab, bus, instance=instance, rigs=rigs, stopping=stopping) as service:
        running.append(service)
        with _stop_on_thread_crash(service):
            run(service)
        service.check()
    logger.info("stopped")


@contextlib.contextmanager
def _stop_on_thread_crash(service: Service) -> Iterator[None]:
    """Stop the service if a thread crashes, so that it is restarted instead of running on incompletely."""
    previous = threading.excepthook

    def on_crash(crashed: threading.ExceptHookArgs) -> None:
        previous(crashed)
        if not service.stopping.is_set():
            name = crashed.thread.name if crashed.thread is not None else "unknown"
            service.fail(f"{service.source}: thread {name!r} crashed (see traceback above)")

    threading.excepthook = on_crash
    try:
        yield
    finally:
        threading.excepthook = previous


def _set_scheduling(name: str, lab: LabConfig) -> None:
    """Give the services that close the loop a higher priority than all others."""
    priority = REALTIME_PRIORITIES.get(name)
    if priority is None:
        lower_priority()
        return
    # Before the bus is opened, because its threads inherit both.
    set_short_slice()
    if lab.realtime and not go_realtime(priority):
        logger.debug("no permission for a real-time scheduling policy: other programs may delay this one")


def allow_open_files() -> int:
    """Raise the limit of open files to the hard limit, and return it.

    Each connection needs one, and the usual soft limit is 1,024.
    """
    if sys.platform == "win32":
        return DEFAULT_OPEN_FILES
    import resource

    _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    # Some systems report no limit, but accept less.
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard_limit, hard_limit))
    soft_limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if soft_limit == resource.RLIM_INFINITY else soft_limit


def _open_bus(lab: LabConfig, name: str, instance: str, stopping: threading.Event) -> Bus | None:
    """Open the bus; wait for the router, because the two may start in any order. None: stopped while waiting."""
    waiting = False
    while not stopping.is_set():
        try:
            return ZenohBus(lab.bus, name, instance)
        except OperationError as error:
            if lab.bus.topology != "router":
                raise
            if not waiting:
                logger.warning("waiting: %s", error)
            waiting = True
            stopping.wait(ROUTER_RETRY_S)
    return None
