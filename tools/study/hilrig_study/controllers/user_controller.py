"""User-written controller: loads a class `Controller` from a Python file and checks each of its results.

The file need not import hilrig (see `examples/controllers/`):

    class Controller:
        def __init__(self, period_s, gain): ...
        def update(self, time_s, position, goal, latency_s): return [t1, t2, t3, t4]

`position` and `goal` are four floats each (rad, rad, m, rad). The return value is four efforts (N·m, N·m, N, N·m). Each
run has its own instance of the class. The file is loaded, and all runs of a control step are updated, within
`TIME_LIMIT_S`. Code that ends the process raises an error instead. Code that an exception does not end, because it
catches all of them or never returns from a C function, ends the process after twice this time.
"""

import contextlib
import faulthandler
import importlib.util
import itertools
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.control_laws import Measurement

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TIME_LIMIT_S: Final = 10.0
"""Largest time for loading a file, and for one control step of all runs of a batch."""

_module_numbers = itertools.count()


class _TimeLimitError(BaseException):
    """The time limit has passed. Not an `Exception`, which user code may catch."""


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Limit the time of user code, and let an exit of the process raise `SystemExit`.

    Only the main thread of a process, which runs the studies, can be interrupted.
    """
    exit_process = os._exit

    def refuse_exit(status: int = 0) -> NoReturn:
        raise SystemExit(status)

    def time_out(*_: object) -> NoReturn:
        raise _TimeLimitError(f"did not return within {TIME_LIMIT_S:g} s")

    has_timer = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    os._exit = refuse_exit
    before = signal.signal(signal.SIGALRM, time_out) if has_timer else None
    try:
        if has_timer:
            signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT_S)
            # Some code is not interrupted by an exception: this prints its line and ends the process.
            faulthandler.dump_traceback_later(2 * TIME_LIMIT_S, exit=True)
        yield
    finally:
        if has_timer:
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        os._exit = exit_process


def _defect(error: BaseException) -> str:
    if isinstance(error, _TimeLimitError):
        return str(error)
    if isinstance(error, SystemExit):
        return f"ended the process (exit code {error.code!r}); return or raise an exception instead"
    return f"raised {type(error).__name__}: {error}"


class UserController:
    """Controller that calls one instance of the user's class per run."""

    def __init__(self, path: Path, period_s: float, gain: Floats | float = 1.0) -> None:
        """Load the file; `gain` is one number for all runs or one per run, (N,).

        Raises:
            InputError: the file can't be read or executed, or has no class `Controller` with a method `update`.
        """
        self._path, self._period_s = path, period_s
        self._gain = np.atleast_1d(np.asarray(gain, dtype=np.float64))
        self._class = _class_of(_load(path), path)
        self._objects: list[Any] = []

    def reset(self, runs: int) -> None:
        """Implement `Controller.reset`.

        Raises:
            InputError: the class can't be instantiated.
        """
        gains = np.broadcast_to(self._gain, runs).tolist()
        with _limited():
            self._objects = [self._call(partial(self._class, self._period_s, gain), "__init__") for gain in gains]

    def update(self, measured: Measurement, due: Bools | None = None) -> Floats:
        """Implement `Controller.update`.

        Raises:
            InputError: `update` raised an exception, or did not return four finite numbers.
        """
        effort = np.zeros_like(measured.position)
        runs = range(len(self._objects)) if due is None else np.flatnonzero(due).tolist()
        positions, goals = measured.position.T.tolist(), measured.goal.T.tolist()
        with _limited():
            for run in runs:
                time_s, latency_s = float(measured.time_s[run]), float(measured.latency_s[run])
                update = partial(self._objects[run].update, time_s, positions[run], goals[run], latency_s)
                effort[:, run] = self._checked(self._call(update, "update", time_s), time_s)
        return effort

    def _call(self, call: Callable[[], Any], method: str, time_s: float | None = None) -> Any:
        try:
            return call()
        except (Exception, SystemExit, _TimeLimitError) as error:
            when = "" if time_s is None else f" at t = {time_s:.3f} s"
            raise InputError(
                f"{self._path}{_line(error, self._path)}: Controller.{method} {_defect(error)}{when}"
            ) from error

    def _checked(self, result: Any, time_s: float) -> Floats:
        try:
            effort = np.asarray(result, dtype=np.float64)
        except (TypeError, ValueError):
            effort = np.empty(0)
        if effort.shape != (4,) or not np.isfinite(effort).all():
            raise InputError(
                f"{self._path}: Controller.update must return four finite numbers (N·m, N·m, N, N·m), "
                f"got {result!r} at t = {time_s:.3f} s"
            )
        return effort


def _line(error: BaseException, path: Path) -> str:
    """The line of the file in which an error was raised, for a message."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f", line {frames[-1].lineno}" if frames else ""


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"hilrig_user_controller_{next(_module_numbers)}", path)
    if path.suffix != ".py" or not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"{path}: not a readable Python file (.py)")
    module = importlib.util.module_from_spec(spec)
    try:
        with _limited():
            spec.loader.exec_module(module)
    except (SystemExit, _TimeLimitError) as error:
        raise InputError(f"{path}{_line(error, path)}: import failed: {_defect(error)}") from error
    except Exception as error:
        raise InputError(f"{path}: import failed: {type(error).__name__}: {error}") from error
    return module


def _class_of(module: ModuleType, path: Path) -> Callable[[float, float], Any]:
    found = getattr(module, "Controller", None)
    if not isinstance(found, type) or not callable(getattr(found, "update", None)):
        raise InputError(
            f"{path}: no class Controller with a method update(time_s, position, goal, latency_s); "
            "see the example examples/controllers/pd.py"
        )
    loaded: Callable[[float, float], Any] = found
    return loaded
