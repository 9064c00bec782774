"""Worker process for tasks that need much time or memory: runs one call at a time, and is started on demand.

The process has low priority. It ends with its parent process, which it detects by the closed pipe between them.
"""

import contextlib
import logging
import multiprocessing
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Final

from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.timing.realtime import lower_priority

_SPAWN: Final = multiprocessing.get_context("spawn")

logger = logging.getLogger(__name__)


class Worker:
    """Calls methods of the object returned by `factory(*arguments)`, in a worker process."""

    def __init__(self, factory: Callable[..., Any], *arguments: Any) -> None:
        self._factory = (factory, arguments)
        self._lock = threading.Lock()
        self._closed = False
        self._process: Any = None
        self._pipe: Any = None

    def call(self, method: str, *arguments: Any, timeout_s: float) -> Any:
        """Call a method and return its result; concurrent calls are executed one after the other.

        Raises:
            HilrigError: the method raised it.
            OperationError: the call timed out, the process ended, or the worker is closed.
        """
        with self._lock:
            self._start()
            if self._closed:
                self._stop()
                raise OperationError("the worker is being closed")
            try:
                self._pipe.send((method, arguments))
                if not self._pipe.poll(timeout_s):
                    self._stop()
                    raise OperationError(f"no result within {timeout_s:.0f} s")
                succeeded, value = self._pipe.recv()
            except (EOFError, OSError) as error:
                self._stop()
                raise OperationError("the worker process ended unexpectedly (out of memory?)") from error
        if not succeeded:
            raise value
        return value

    def stop(self) -> None:
        """Stop the process after its current call; the next call starts a new one."""
        with self._lock:
            self._stop()

    def close(self) -> None:
        """Kill the process and reject further calls; a waiting call raises an error."""
        self._closed = True
        process = self._process
        if process is not None:
            process.kill()

    def _start(self) -> None:
        if self._process is None or not self._process.is_alive():
            self._stop()
            self._pipe, other = _SPAWN.Pipe()
            process = _SPAWN.Process(target=_serve, args=(other, *self._factory), daemon=True)
            process.start()
            other.close()
            # Visible to `close` only when the process can be killed.
            self._process = process

    def _stop(self) -> None:
        process, pipe, self._process, self._pipe = self._process, self._pipe, None, None
        if pipe is not None:
            pipe.close()
        if process is not None:
            process.kill()
            process.join()


def _serve(pipe: Connection, factory: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    # Ctrl-C is sent to all processes of a terminal; this process ends with its parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    lower_priority()
    worker = factory(*arguments)
    with contextlib.suppress(EOFError, OSError):
        while True:
            method, method_arguments = pipe.recv()
            try:
                reply = True, getattr(worker, method)(*method_arguments)
            except HilrigError as error:
                reply = False, error
            except Exception:
                logger.exception("%s failed", method)
                reply = False, OperationError("the worker failed; see the log of the console")
            pipe.send(reply)
