"""Rows of a recording as Arrow tables, and as data frames of pandas or polars."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

import numpy as np
import pyarrow as pa

from hilrig_replay.io.columns import Rows
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError, OperationError, install_command
from hilrig_sim.arm.joints import JOINT_NAMES

TABLES: Final[dict[str, Callable[[Records], Rows]]] = {
    "state": lambda records: records.states,
    "command": lambda records: records.commands,
    "event": lambda records: records.events,
    "traffic": lambda records: records.traffic,
}
"""Tables of a recording by name."""
_INTERNED_FIELDS: Final = frozenset({"session", "held_part", "controller", "part"})
"""Fields that hold a code of the run's string table."""
LIBRARIES: Final = ("pandas", "polars")
"""Libraries of data frames, in the extra `frames`."""


def table(run: Run, rows: Rows, escape: Callable[[str], str] = str) -> pa.Table:
    """Convert rows of one of `TABLES` to an Arrow table.

    Units are SI as in the schemas, and `time_s` is the time since the run's first state. A joint vector becomes four
    columns, one per joint. `escape` converts each text.
    """
    columns: dict[str, Any] = {"time_s": run.time_s(rows)}
    for field in rows.dtype.names or ():
        values = rows[field]
        if field == "message":
            continue
        if field in _INTERNED_FIELDS:
            columns[field] = pa.array(map(escape, run.names.texts(values).tolist()), pa.string())
        elif values.ndim == 2:
            for number, joint in enumerate(JOINT_NAMES):
                columns[f"{field}_{joint}"] = np.ascontiguousarray(values[:, number])
        elif values.dtype == object:
            columns[field] = pa.array(map(escape, values.tolist()), pa.string())
        else:
            columns[field] = np.ascontiguousarray(values)
    return pa.table(columns)


def frame(table: pa.Table, library: str) -> Any:
    """Convert an Arrow table to a data frame.

    Raises:
        InputError: unknown library.
        OperationError: the library is not installed.
    """
    if library not in LIBRARIES:
        raise InputError(f"library: expected one of {', '.join(LIBRARIES)}, got {library!r}")
    try:
        module = import_module(library)
    except ImportError as error:
        fix = f"in hilrig's folder: {install_command('frames')}"
        raise OperationError(f"{library} is not installed: {fix}") from error
    return table.to_pandas() if library == "pandas" else module.from_arrow(table)
