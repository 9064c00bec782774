"""Processes for work that is worth all cores: one a core, each with its share of the tasks."""

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
    """Give an executor; whoever leaves the context by an exception waits for no task that has not begun.

    Args:
        tasks: that there are; there are no more processes than that.
        workers: processes; default: one a core. Of one alone, the work is done in this process.

    Raises:
        OperationError: a process ended before its task.
    """
    count = min(workers or os.cpu_count() or 1, tasks)
    if count <= 1:
        yield _Here()
        return
    # Spawned, never forked: a process of threads that is forked may hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=_leave_interrupts_to_the_parent) as executor:
        try:
            yield executor
        except BrokenProcessPool as error:
            raise OperationError("a process that did a part of the work ended; memory may be short") from error
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


class _Here(Executor):
    """Does each task where and when it is submitted."""

    def submit(self, task: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(task(*given, **named))
        except Exception as error:
            future.set_exception(error)
        return future


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
