"""A table of any length: the rows are in a temporary file, with one block in memory.

Measurements of a run are added while the run is read. Percentiles, plots and the diagnosis then read them again, one
column at a time. The file has no name and is deleted with the table or the process.
"""

import tempfile
from collections.abc import Callable, Iterator
from typing import Any, Final, TypeAlias, overload
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows
from hilrig_runtime.errors import OperationError

ROWS_PER_BLOCK: Final = 32_768
"""Maximum number of rows in memory; a shorter table is not written to disk."""

Blocks: TypeAlias = Callable[[], Iterator[NDArray[Any]]]
"""Function that returns a new iterator over blocks of values, each of shape (n,)."""


class DiskTable:
    """Disk-backed column table; rows are in the order in which they were added.

    The file contains blocks of `block` rows, each stored column by column, so reading a column reads nothing else.
    `table["loop"]` is a complete column as an array, `table[5:-5]` is a range of rows; both must fit into memory.
    """

    def __init__(self, dtype: np.dtype[np.void], *, block: int = ROWS_PER_BLOCK) -> None:
        self.dtype = dtype
        self._size = block
        self._newest: list[Rows] = []
        """Rows that do not fill a block yet."""
        self._buffered = 0
        self._blocks = 0
        self._file: Any = None

    def __len__(self) -> int:
        return self._blocks * self._size + self._buffered

    def add(self, rows: Rows) -> None:
        """Append rows, fields as `dtype`.

        Raises:
            OperationError: the temporary file can't be written.
        """
        if not len(rows):
            return
        self._newest.append(rows)
        self._buffered += len(rows)
        if self._buffered < self._size:
            return
        buffered = np.concatenate(self._newest)
        full = len(buffered) - len(buffered) % self._size
        for begin in range(0, full, self._size):
            self._write(buffered[begin : begin + self._size])
        self._newest, self._buffered = [buffered[full:].copy()], len(buffered) - full

    def column(self, name: str) -> Blocks:
        """Blocks of one column."""
        return lambda: (rows[name] for rows in self.blocks(name))

    def blocks(self, *names: str) -> Iterator[Rows]:
        """Iterate over all rows with the given fields, in blocks of shape (n,)."""
        for block in range(self._blocks):
            rows = np.empty(self._size, [(name, self.dtype[name]) for name in names])
            for name in names:
                values = np.empty(self._size, self.dtype[name])
                self._file.seek(self._offset(block, name))
                self._file.readinto(values.data)
                rows[name] = values
            yield rows
        if self._buffered:
            self._newest = [np.concatenate(self._newest)]
            yield self._newest[0][list(names)]

    @overload
    def __getitem__(self, key: str) -> NDArray[Any]: ...

    @overload
    def __getitem__(self, key: slice) -> Rows: ...

    def __getitem__(self, key: str | slice) -> NDArray[Any]:
        if isinstance(key, str):
            return np.concatenate([np.empty(0, self.dtype[key]), *self.column(key)()])
        rows = np.concatenate([np.empty(0, self.dtype), *self.blocks(*(self.dtype.names or ()))])
        return rows[key]

    def _offset(self, block: int, name: str) -> int:
        """Position of a column of a block in the file."""
        assert self.dtype.fields is not None
        return self._size * (block * self.dtype.itemsize + self.dtype.fields[name][1])

    def _write(self, rows: Rows) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
                finalize(self, self._file.close)
            self._file.seek(self._offset(self._blocks, (self.dtype.names or ("",))[0]))
            for name in self.dtype.names or ():
                self._file.write(np.ascontiguousarray(rows[name]).data)
            self._file.flush()
        except OSError as error:
            folder, cause = tempfile.gettempdir(), error.strerror or error
            raise OperationError(
                f"{folder}: the temporary table of a long run can't be written: {cause}; set TMPDIR to another folder"
            ) from error
        self._blocks += 1
