"""A pool of worker processes for long computations, by default one per processor core."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from hilrig_runtime.errors import OperationError


@contextmanager
def process_pool(tasks: int, workers: int | None = None) -> Iterator[Executor]:
    """Provide an executor; an exception that leaves the context cancels the tasks that have not started.

    Args:
        tasks: number of tasks, the largest number of processes.
        workers: number of processes; default: one per core. With one, the work is done in this process.

    Raises:
        OperationError: a worker process died.
    """
    count = min(workers or os.cpu_count() or 1, tasks)
    if count <= 1:
        yield _InlineExecutor()
        return
    # Spawned, never forked: a process with threads may hang after a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=_ignore_interrupts) as executor:
        try:
            yield executor
        except BrokenProcessPool as error:
            raise OperationError("a worker process died: out of memory, or code of a controller ended it") from error
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


class _InlineExecutor(Executor):
    """Runs each task at once, in the calling thread."""

    def submit(self, task: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(task(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
