"""How a process ends: signals, the parent's death, exit codes, and a way out when closing hangs.

The first signal sets the wish to stop and the loop ends itself; a second one forces. A service started by
`hilrig up` also ends when its parent is gone, which it learns from the end of its standard input. Every command ends
this way, so that this module imports nothing that takes time.
"""

import errno
import io
import itertools
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Final

from hilrig_runtime.errors import HilrigError, OperationError

CLOSE_TIMEOUT_S: Final = 2.0
"""A process that has not closed by then ends all the same."""
EXIT_SIGPIPE: Final = 141
"""Exit code where whoever read the output has seen enough: what a shell says of a program that SIGPIPE ended."""
TURN_S: Final = 0.5
"""Of waiting for a signal."""
_NO_ROOM: Final = (errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC))
"""What a full or broken disk says to whoever writes."""
_NO_HANDLES: Final = (errno.EMFILE, errno.ENFILE)
_NO_THREAD: Final = "can't start new thread"
"""What Python says where the system gives it none."""


def stop_on_signals(stopping: threading.Event) -> None:
    """Set `stopping` on the first SIGINT or SIGTERM; end the process on the second."""
    count = itertools.count()
    heard: SimpleQueue[int] = SimpleQueue()

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        # Counted too, for a second one may come while the first is being handled.
        if next(count) or stopping.is_set():
            os._exit(128 + number)
        # A signal may come while this very thread holds the event's lock: to set it here could wait without end. This
        # kind of queue has no such lock.
        heard.put(number)

    def tell() -> None:
        heard.get()
        stopping.set()

    threading.Thread(target=tell, name="signals", daemon=True).start()
    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGBREAK", None)):
        if number is not None:
            signal.signal(number, on_signal)


def wait_for(stopping: threading.Event) -> None:
    """Wait until `stopping` is set by a signal.

    In turns: Python hears of a signal between two instructions, and one that comes just as the main thread begins to
    wait would only be heard of when it wakes.
    """
    while not stopping.wait(TURN_S):
        pass


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


def force_exit_after(stopping: threading.Event, timeout_s: float) -> None:
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
    _open_output()
    try:
        return _run_and_tell(main)
    except BrokenPipeError:
        pass
    except SystemExit as end:
        # What parses and what prints tables both make 1 of a closed pipe, which is an answer here.
        if not isinstance(end.__context__, BrokenPipeError):
            raise
    _drop_output()
    return EXIT_SIGPIPE


def _run_and_tell(main: Callable[[], int | None]) -> int:
    try:
        try:
            return main() or 0
        finally:
            # While its failure can still be told.
            sys.stdout.flush()
    except HilrigError as error:
        for line in str(error).splitlines():
            print(f"hilrig: error: {line}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and str(error) != _NO_THREAD:
            raise
        print(
            "hilrig: error: the system gives this process no more memory or threads: see its limits (ulimit -v, "
            "ulimit -u; mem_limit and pids_limit of a container), or end what else runs here",
            file=sys.stderr,
        )
        return OperationError.exit_code
    except OSError as error:
        if error.errno in _NO_HANDLES:
            print(
                "hilrig: error: the system gives this process no more open files: allow it more (ulimit -n, or "
                "LimitNOFILE of a service)",
                file=sys.stderr,
            )
            return OperationError.exit_code
        if error.errno not in _NO_ROOM:
            raise
        _drop_output()
        where = error.filename or "the output"
        print(f"hilrig: error: {where}: can't be written: {error.strerror}", file=sys.stderr)
        return OperationError.exit_code


def _open_output() -> None:
    """Have somewhere to write, whatever the shell closed, and a sign for what its encoding can't say."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 (it stays open)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _drop_output() -> None:
    """What is still buffered goes nowhere, so that the end of the process is quiet."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
