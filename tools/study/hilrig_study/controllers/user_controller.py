"""A student's controller out of a Python file: a class `Controller` of his own, checked at every turn.

The file needs nothing of hilrig (`examples/controllers/`):

    class Controller:
        def __init__(self, period_s, gain): ...
        def update(self, time_s, position, goal, latency_s): return [t1, t2, t3, t4]

`position` and `goal` are four floats each (rad, rad, m, rad), the return value four efforts (N·m, N·m, N, N·m). Each
run has an object of its own, so what it remembers is its own matter.
"""

import importlib.util
import itertools
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.controllers import Measured

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_numbers = itertools.count()


class StudentController:
    """As `controllers.Controller`: one object of the student's class a run."""

    def __init__(self, path: Path, period_s: float, gain: Floats | float = 1.0) -> None:
        """Load the file; `gain` is a number for all runs or one a run, (N,).

        Raises:
            InputError: the file can't be read or run, or has no class `Controller` with a method `update`.
        """
        self._path, self._period_s = path, period_s
        self._gain = np.atleast_1d(np.asarray(gain, dtype=np.float64))
        self._class = _class_of(_load(path), path)
        self._objects: list[Any] = []

    def begin(self, runs: int) -> None:
        """As `Controller`.

        Raises:
            InputError: the class can't be made.
        """
        gains = np.broadcast_to(self._gain, runs).tolist()
        self._objects = [self._call(partial(self._class, self._period_s, gain), "__init__") for gain in gains]

    def update(self, measured: Measured, due: Bools | None = None) -> Floats:
        """As `Controller`.

        Raises:
            InputError: an `update` raised, or gave something else than four finite numbers.
        """
        effort = np.zeros_like(measured.position)
        runs = range(len(self._objects)) if due is None else np.flatnonzero(due).tolist()
        positions, goals = measured.position.T.tolist(), measured.goal.T.tolist()
        for run in runs:
            time_s, latency_s = float(measured.time_s[run]), float(measured.latency_s[run])
            update = partial(self._objects[run].update, time_s, positions[run], goals[run], latency_s)
            effort[:, run] = self._checked(self._call(update, "update", time_s), time_s)
        return effort

    def _call(self, call: Callable[[], Any], method: str, time_s: float | None = None) -> Any:
        try:
            return call()
        except Exception as error:
            frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(self._path)]
            line = f", line {frames[-1].lineno}" if frames else ""
            when = "" if time_s is None else f" at {time_s:.3f} s of the run"
            raise InputError(
                f"{self._path}{line}: Controller.{method} raised {type(error).__name__}: {error}{when}"
            ) from error

    def _checked(self, given: Any, time_s: float) -> Floats:
        try:
            effort = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            effort = np.empty(0)
        if effort.shape != (4,) or not np.isfinite(effort).all():
            raise InputError(
                f"{self._path}: Controller.update must give four finite numbers (N·m, N·m, N, N·m); "
                f"at {time_s:.3f} s of the run it gave {given!r}"
            )
        return effort


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"hilrig_student_{next(_numbers)}", path)
    if path.suffix != ".py" or not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"{path}: a controller is a Python file (.py) that can be read")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path}: can't be run: {type(error).__name__}: {error}") from error
    return module


def _class_of(module: ModuleType, path: Path) -> Callable[[float, float], Any]:
    found = getattr(module, "Controller", None)
    if not isinstance(found, type) or not callable(getattr(found, "update", None)):
        raise InputError(
            f"{path}: has no class Controller with a method update(time_s, position, goal, latency_s): "
            "examples/controllers/pd.py is one to start from"
        )
    made: Callable[[float, float], Any] = found
    return made
