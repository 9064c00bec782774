"""A table of any length: its rows are in a temporary file, and a block of them in memory.

What is measured of a run is added as the run is read, and gone through again, a column at a time, for what needs all of
it: percentiles, plots, the diagnosis. The file has no name, and ends with the table or its process.
"""

import tempfile
from collections.abc import Callable, Iterator
from typing import Any, Final, TypeAlias, overload
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows
from hilrig_runtime.errors import OperationError

BLOCK: Final = 32_768
"""Rows that are kept in memory, count: a shorter table never touches the disk."""

Blocks: TypeAlias = Callable[[], Iterator[NDArray[Any]]]
"""Values piece by piece, each piece of shape (n,); every call goes through them from the beginning."""


class Spool:
    """Rows in the order in which they were added.

    Blocks of `block` rows stand in the file one after the other, each column by column: who goes through a column reads
    nothing else. `spool["loop"]` is a whole column as an array, and `spool[5:-5]` some rows, for tables that fit.
    """

    def __init__(self, dtype: np.dtype[np.void], *, block: int = BLOCK) -> None:
        self.dtype = dtype
        self._size = block
        self._newest: list[Rows] = []
        """Rows that do not fill a block yet."""
        self._waiting = 0
        self._blocks = 0
        self._file: Any = None

    def __len__(self) -> int:
        return self._blocks * self._size + self._waiting

    def add(self, rows: Rows) -> None:
        """Take in some more, fields as `dtype`.

        Raises:
            OperationError: the disk has no room for them.
        """
        if not len(rows):
            return
        self._newest.append(rows)
        self._waiting += len(rows)
        if self._waiting < self._size:
            return
        whole = np.concatenate(self._newest)
        full = len(whole) - len(whole) % self._size
        for begin in range(0, full, self._size):
            self._write(whole[begin : begin + self._size])
        self._newest, self._waiting = [whole[full:].copy()], len(whole) - full

    def column(self, name: str) -> Blocks:
        """One field."""
        return lambda: (rows[name] for rows in self.blocks(name))

    def blocks(self, *names: str) -> Iterator[Rows]:
        """All rows with some of their fields, each block of shape (n,)."""
        for block in range(self._blocks):
            rows = np.empty(self._size, [(name, self.dtype[name]) for name in names])
            for name in names:
                values = np.empty(self._size, self.dtype[name])
                self._file.seek(self._place(block, name))
                self._file.readinto(values.data)
                rows[name] = values
            yield rows
        if self._waiting:
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

    def _place(self, block: int, name: str) -> int:
        """Where a column of a block begins in the file."""
        assert self.dtype.fields is not None
        return self._size * (block * self.dtype.itemsize + self.dtype.fields[name][1])

    def _write(self, rows: Rows) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
                finalize(self, self._file.close)
            self._file.seek(self._place(self._blocks, (self.dtype.names or ("",))[0]))
            for name in self.dtype.names or ():
                self._file.write(np.ascontiguousarray(rows[name]).data)
            self._file.flush()
        except OSError as error:
            folder, why = tempfile.gettempdir(), error.strerror or error
            raise OperationError(
                f"{folder}: can't hold the table of a long run: {why}; TMPDIR names another"
            ) from error
        self._blocks += 1
