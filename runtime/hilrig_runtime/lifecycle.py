"""How a process begins and ends: signals, the parent's death, exit codes, and a way out when closing hangs.

The first signal sets the wish to stop and the loop ends itself; a second one forces. A service started by
`hilrig up` also ends when its parent is gone, which it learns from the end of its standard input.
"""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Final

from hilrig_runtime.bus import Bus
from hilrig_runtime.config import LabConfig
from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.realtime import REALTIME_PRIORITIES, go_realtime, prefer_latency, yield_to_others
from hilrig_runtime.service import Service
from hilrig_runtime.zenoh_bus import ZenohBus

CLOSE_TIMEOUT_S: Final = 2.0
"""A process that has not closed by then ends all the same."""
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
    stopping = threading.Event()
    stop_on_signals(stopping)
    if stop_with_parent:
        stop_with_stdin(stopping)
    end_when_closing_hangs(stopping, close_timeout_s)
    bus = _open_bus(lab, name, instance, stopping)
    if bus is None:
        return
    with Service(name, lab, bus, instance=instance, rigs=rigs, stopping=stopping) as service:
        logger.debug("running as %s", service.source)
        run(service)
        service.check()


def _ask_for_time(name: str, lab: LabConfig) -> None:
    """Services whose punctuality is the product go first, the others may wait for their turn."""
    priority = REALTIME_PRIORITIES.get(name)
    if priority is None:
        yield_to_others()
        return
    # Before the bus is opened: its threads inherit both.
    prefer_latency()
    if lab.realtime and not go_realtime(priority):
        logger.debug("the system grants no real-time policy: other programs may hold up this one")


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


def stop_on_signals(stopping: threading.Event) -> None:
    """Set `stopping` on the first SIGINT or SIGTERM; end the process on the second."""

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        if stopping.is_set():
            os._exit(128 + number)
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGBREAK", None)):
        if number is not None:
            signal.signal(number, on_signal)


def stop_with_stdin(stopping: threading.Event) -> None:
    """Set `stopping` when standard input ends: the parent held its other end, and is gone."""

    def watch() -> None:
        try:
            while os.read(0, 4096):
                pass
        except OSError:
            pass
        stopping.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def end_when_closing_hangs(stopping: threading.Event, timeout_s: float) -> None:
    """End the process `timeout_s` after `stopping` was set, if it is still there: a hung session ignores signals."""

    def watch() -> None:
        stopping.wait()
        # A daemon thread: it ends with the process when closing goes well.
        threading.Event().wait(timeout_s)
        print("hilrig: closing took too long; ended without", file=sys.stderr)
        os._exit(3)

    threading.Thread(target=watch, name="close-guard", daemon=True).start()


def run_main(main: Callable[[], int | None]) -> int:
    """Run a command; turn what a person should read into one line on standard error, and an exit code."""
    try:
        return main() or 0
    except HilrigError as error:
        for line in str(error).splitlines():
            print(f"hilrig: error: {line}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever read our output has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
