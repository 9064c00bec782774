"""A process of its own for work that takes long or much memory: one call at a time, started when there is one.

It steps back behind whatever else runs on the machine, and ends with the process that started it, whose end it learns
from the pipe between them.
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
    """Calls methods of what `make(*arguments)` gives, in a process of its own."""

    def __init__(self, make: Callable[..., Any], *arguments: Any) -> None:
        self._made = (make, arguments)
        self._turn = threading.Lock()
        self._closed = False
        self._process: Any = None
        self._pipe: Any = None

    def call(self, method: str, *arguments: Any, timeout_s: float) -> Any:
        """What the method gives; whoever else calls meanwhile waits for his turn.

        Raises:
            HilrigError: the method raised it.
            OperationError: it takes too long, the process ended, or the worker is closed.
        """
        with self._turn:
            self._start()
            if self._closed:
                self._end()
                raise OperationError("it is being closed")
            try:
                self._pipe.send((method, arguments))
                if not self._pipe.poll(timeout_s):
                    self._end()
                    raise OperationError(f"it takes longer than {timeout_s:.0f} s")
                done, value = self._pipe.recv()
            except (EOFError, OSError) as error:
                self._end()
                raise OperationError("the process that does it ended; memory may be short") from error
        if not done:
            raise value
        return value

    def end(self) -> None:
        """End the process, when it has done what it does; the next call starts another."""
        with self._turn:
            self._end()

    def close(self) -> None:
        """End the process at once, and start none any more; whoever waits for a call is told that it ended."""
        self._closed = True
        process = self._process
        if process is not None:
            process.kill()

    def _start(self) -> None:
        if self._process is None or not self._process.is_alive():
            self._end()
            self._pipe, other = _SPAWN.Pipe()
            process = _SPAWN.Process(target=_serve, args=(other, *self._made), daemon=True)
            process.start()
            other.close()
            # Known to `close` only now that it can be ended.
            self._process = process

    def _end(self) -> None:
        process, pipe, self._process, self._pipe = self._process, self._pipe, None, None
        if pipe is not None:
            pipe.close()
        if process is not None:
            process.kill()
            process.join()


def _serve(pipe: Connection, make: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    # Ctrl-C reaches all processes of a terminal; this one ends with its parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    lower_priority()
    worker = make(*arguments)
    with contextlib.suppress(EOFError, OSError):
        while True:
            method, given = pipe.recv()
            try:
                answer = True, getattr(worker, method)(*given)
            except HilrigError as error:
                answer = False, error
            except Exception:
                logger.exception("%s failed", method)
                answer = False, OperationError("it failed; the log says why")
            pipe.send(answer)
