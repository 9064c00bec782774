"""Reads a rerun file with rerun's own reader: its tables by entity path."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader


class RrdFile:
    """The tables of a rerun file."""

    def __init__(self, path: Path) -> None:
        self.tables: dict[str, list[pa.RecordBatch]] = defaultdict(list)
        self.timelines: set[str] = set()
        for chunk in RrdReader(path).stream().to_chunks():
            self.tables[chunk.entity_path].append(chunk.to_record_batch())
            self.timelines.update(chunk.timeline_names)

    def column(self, path: str, ending: str) -> np.ndarray:
        """A column of an entity, one row per time, sorted by `sim_time`."""
        batches = [batch for batch in self.tables[path] if "sim_time" in batch.schema.names]
        rows, times = [], []
        for batch in batches:
            names = [name for name in batch.schema.names if name.endswith(ending)]
            if names:
                rows.extend(batch.column(names[0]).to_pylist())
                times.extend(batch.column("sim_time").cast(pa.int64()).to_pylist())
        order = np.argsort(times, kind="stable")
        return np.array([rows[number] for number in order])

    def static(self, path: str, ending: str) -> list[Any]:
        """Return the values of a component without a time."""
        batches = [batch for batch in self.tables[path] if "sim_time" not in batch.schema.names]
        return [
            value
            for batch in batches
            for name in batch.schema.names
            if name.endswith(ending)
            for values in batch.column(name).to_pylist()
            for value in values
        ]

    def rows(self, path: str) -> int:
        """Number of an entity's rows with a time."""
        return sum(batch.num_rows for batch in self.tables[path] if "sim_time" in batch.schema.names)
