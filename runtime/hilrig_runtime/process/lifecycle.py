"""The life of a service's process: its share of the processor, the bus, the service, and the end."""

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
from hilrig_runtime.process.shutdown import CLOSE_TIMEOUT_S, force_exit_after, stop_on_signals, stop_with_stdin
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime, lower_priority, set_short_slice

ROUTER_RETRY_S: Final = 0.5

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
    """Open the bus, run a service until it is told to stop, and close everything.

    Raises:
        HilrigError: the service can't start or can't go on; what it opened is closed.
    """
    _ask_for_time(name, lab)
    allow_open_files()
    stopping = threading.Event()
    stop_on_signals(stopping)
    if stop_with_parent:
        stop_with_stdin(stopping)
    force_exit_after(stopping, close_timeout_s)
    bus = _open_bus(lab, name, instance, stopping)
    if bus is None:
        return
    with Service(name, lab, bus, instance=instance, rigs=rigs, stopping=stopping) as service:
        logger.debug("running as %s", service.source)
        with _no_thread_missing(service):
            run(service)
        service.check()


@contextlib.contextmanager
def _no_thread_missing(service: Service) -> Iterator[None]:
    """Where a mistake ends a thread the service would run on with half of its work: it ends, to be started anew."""
    before = threading.excepthook

    def on_mistake(ended: threading.ExceptHookArgs) -> None:
        before(ended)
        if not service.stopping.is_set():
            name = ended.thread.name if ended.thread is not None else "unknown"
            service.fail(f"{service.source}: its thread {name!r} was ended by a mistake in the program (see above)")

    threading.excepthook = on_mistake
    try:
        yield
    finally:
        threading.excepthook = before


def _ask_for_time(name: str, lab: LabConfig) -> None:
    """Services whose punctuality is the product go first, the others may wait for their turn."""
    priority = REALTIME_PRIORITIES.get(name)
    if priority is None:
        lower_priority()
        return
    # Before the bus is opened: its threads inherit both.
    set_short_slice()
    if lab.realtime and not go_realtime(priority):
        logger.debug("the system grants no real-time policy: other programs may hold up this one")


def allow_open_files() -> None:
    """Have as many files open as the system lets this user: each connection is one, and 1,024 is a usual beginning."""
    if sys.platform != "win32":
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        # Some systems call it unlimited and take less.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _open_bus(lab: LabConfig, name: str, instance: str, stopping: threading.Event) -> Bus | None:
    """Join the bus; a service waits for its router, for the two may start in any order. None: told to stop first."""
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
