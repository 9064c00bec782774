"""Shutdown of a process: signals, end of the parent process, exit codes, and a forced exit if closing hangs.

The first signal requests a shutdown and the loop ends itself; a second signal ends the process at once. A service
started by `hilrig up` also stops when its parent ends, which closes its standard input. SIGHUP makes a service read its
configuration again, and ends it only if its terminal was closed. Every command uses this
module, so it imports nothing that is slow to import.
"""

import atexit
import errno
import io
import itertools
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Final, NoReturn

from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.escaping import printable

CLOSE_TIMEOUT_S: Final = 2.0
"""Time after which a process that has not closed is ended, s."""
EXIT_SIGPIPE: Final = 141
"""Exit code if the reader of the output has closed it: 128 + SIGPIPE, as in a shell."""
SIGNAL_POLL_S: Final = 0.5
"""Interval at which the main thread wakes up to handle signals, s."""
_DISK_ERRORS: Final = (errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC))
"""Errors of a full or broken disk."""
_FILE_LIMIT_ERRORS: Final = (errno.EMFILE, errno.ENFILE)
_THREAD_LIMIT_MESSAGE: Final = "can't start new thread"
"""Text of Python's RuntimeError when the system refuses a new thread."""


class ErrorOutput:
    """Output of the errors that end this process; a service that logs JSON replaces `write`."""

    @staticmethod
    def write(line: str) -> None:
        """Print one line on standard error."""
        print(f"hilrig: {line}", file=sys.stderr, flush=True)


def stop_on_signals(*, stop_with_parent: bool = False) -> threading.Event:
    """Return an event that the first SIGINT or SIGTERM sets, and on request the end of the parent process.

    The second signal ends the process.
    """
    stopping = threading.Event()
    count = itertools.count()
    received: SimpleQueue[int] = SimpleQueue()

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        # Counted too, because a second signal may arrive while the first one is handled.
        if next(count) or stopping.is_set():
            os._exit(128 + number)
        # The signal may interrupt this thread while it holds the event's lock, so setting the event here could block
        # forever. SimpleQueue has no such lock.
        received.put(number)

    def set_event() -> None:
        received.get()
        stopping.set()

    threading.Thread(target=set_event, name="signals", daemon=True).start()
    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGBREAK", None)):
        if number is not None:
            signal.signal(number, on_signal)
    if stop_with_parent:
        stop_with_stdin(stopping)
    return stopping


def call_on_hangup(callback: Callable[[], None], stopping: threading.Event) -> None:
    """Call `callback`, in a thread, at each SIGHUP; set `stopping` instead if this process has lost its terminal."""
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is None:
        return
    # A program that was started with nohup runs on without its terminal.
    stops_with_terminal = signal.getsignal(hangup) is not signal.SIG_IGN and _has_terminal()
    received: SimpleQueue[int] = SimpleQueue()

    def handle() -> None:
        while True:
            received.get()
            if stops_with_terminal and not _has_terminal():
                stopping.set()
            else:
                callback()

    threading.Thread(target=handle, name="hangups", daemon=True).start()
    signal.signal(hangup, lambda number, frame: received.put(number))  # noqa: ARG005


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


def wait_for(stopping: threading.Event) -> None:
    """Wait until `stopping` is set by a signal.

    Waits in short intervals: Python runs signal handlers between two instructions, so a signal that arrives just
    before the main thread blocks would only be handled when it wakes up.
    """
    while not stopping.wait(SIGNAL_POLL_S):
        pass


def stop_with_stdin(stopping: threading.Event) -> None:
    """Set `stopping` when standard input is closed, because the parent process has ended."""

    def watch() -> None:
        try:
            while os.read(0, 4096):
                pass
        except OSError:
            pass
        stopping.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def force_exit_after(stopping: threading.Event, timeout_s: float) -> None:
    """End the process `timeout_s` after `stopping` was set, if it still runs: a hung zenoh session ignores signals."""

    def watch() -> None:
        stopping.wait()
        # A daemon thread: it ends with the process if closing succeeds.
        threading.Event().wait(timeout_s)
        ErrorOutput.write("error: shutdown timed out; exiting anyway")
        os._exit(3)

    threading.Thread(target=watch, name="close-guard", daemon=True).start()


def run_process(main: Callable[[], int | None]) -> NoReturn:
    """Run a command in this process as `run_main`, and end the process with its exit code.

    Threads, functions of `atexit` and output are completed as by the interpreter, which is not ended itself: that would
    end the threads of the bus in the middle of a callback, and abort the process.
    """
    code: int | str | None = 1
    try:
        code = run_main(main)
    except SystemExit as end:
        code = end.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
    # As the interpreter: other threads, functions at the end, output.
    with suppress(KeyboardInterrupt):
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
    if isinstance(code, str):
        ErrorOutput.write(code)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code if isinstance(code, int) else code is not None)


def run_main(main: Callable[[], int | None]) -> int:
    """Run a command; print its errors as single lines on standard error, and return its exit code."""
    _open_output()
    try:
        return _run_and_report(main)
    except BrokenPipeError:
        pass
    except SystemExit as end:
        # typer and rich turn a closed pipe into exit code 1, which means "check failed" here.
        if not isinstance(end.__context__, BrokenPipeError):
            raise
    # An error message that could not be written is still in the buffer of standard error.
    _drop_output(1, 2)
    return EXIT_SIGPIPE


def _run_and_report(main: Callable[[], int | None]) -> int:
    try:
        try:
            return main() or 0
        finally:
            # Here a failure can still be reported.
            sys.stdout.flush()
    except HilrigError as error:
        for line in str(error).splitlines():
            ErrorOutput.write(f"error: {printable(line)}")
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and str(error) != _THREAD_LIMIT_MESSAGE:
            raise
        ErrorOutput.write(
            "error: out of memory or threads: raise the limits (ulimit -v, ulimit -u; mem_limit and pids_limit of a "
            "container), or stop other programs"
        )
        return OperationError.exit_code
    except OSError as error:
        if error.errno in _FILE_LIMIT_ERRORS:
            ErrorOutput.write("error: too many open files: raise the limit (ulimit -n, or LimitNOFILE of a service)")
            return OperationError.exit_code
        if error.errno not in _DISK_ERRORS:
            raise
        _drop_output(1)
        target = error.filename or "standard output"
        ErrorOutput.write(f"error: {printable(str(target))}: can't be written: {error.strerror}")
        return OperationError.exit_code


def _open_output() -> None:
    """Make standard output and error writable, even if the shell closed them or their encoding lacks a character."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 (it stays open)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _drop_output(*descriptors: int) -> None:
    """Discard the buffered output of `descriptors`, so that the process ends without another error."""
    null = os.open(os.devnull, os.O_WRONLY)
    for descriptor in descriptors:
        os.dup2(null, descriptor)
