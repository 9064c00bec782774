"""Exports the register map: Markdown for `docs/registers.md`, CSV for PLC tools, rows for programs."""

import csv
import io
from typing import Final

from hilrig_modbus_edge.registers.map import MAP, UNIT_IDS, Register, RegisterTable

_TITLES: Final = {
    RegisterTable.HOLDING_REGISTER: ("Holding registers", "read with 3, written with 6, 16, 22 and 23"),
    RegisterTable.COIL: ("Coils", "read with 1, written with 5 and 15"),
    RegisterTable.INPUT_REGISTER: ("Input registers", "read with 4"),
    RegisterTable.DISCRETE_INPUT: ("Discrete inputs", "read with 2"),
}
_NAMES: Final = {
    RegisterTable.HOLDING_REGISTER: "holding register",
    RegisterTable.COIL: "coil",
    RegisterTable.INPUT_REGISTER: "input register",
    RegisterTable.DISCRETE_INPUT: "discrete input",
}

_INTRODUCTION: Final = """# Registers

Generated from `hilrig_modbus_edge/registers/map.py` by `hilrig registers --markdown`; `hilrig registers --csv` prints
the same map for import into a PLC tool.

Each rig has its own TCP port. Register number n of a table is address n - 1 in a request; PLC tools call holding
register 1 "40001". Values are big-endian; a value of two registers has the more significant register first. A register
with a scale contains the value times the scale: -12.34° at scale 100 is -1234.

Holding registers 1-8 and coil 1 are the map of the paper; a controller needs nothing else. A block read returns one
step of the simulation: no value is torn, and no two values are from different steps. A block write is executed as a
whole or not at all. A read or write of an address that is not in these tables gets exception 02, and so does a write of
a read-only register. A watchdog timeout outside the bounds of the lab gets exception 04. A read of a position gets
exception 04 until the simulation has published its first state.
"""


def as_markdown() -> str:
    """Return the page `docs/registers.md`."""
    parts = [_INTRODUCTION]
    units = ", ".join(str(unit) for unit in sorted(UNIT_IDS))
    parts.append(f"\nAccepted unit identifiers: {units}; a request to another one gets exception 0B.\n")
    for table, (title, functions) in _TITLES.items():
        parts.append(f"\n## {title}\n\nFunctions: {functions}.\n")
        parts.append("\n| number | address | name | type | unit | scale | written by | description |")
        parts.append("\n|---:|---:|---|---|---|---:|---|---|\n")
        for row in _rows(table):
            last = row.number + row.type.words - 1
            number = str(row.number) if last == row.number else f"{row.number}-{last}"
            scale = str(row.scale) if row.scale > 1 else ""
            owner = "controller" if row.writable else "rig"
            cells = (number, row.address, f"`{row.name}`", row.type.value, row.unit, scale, owner, row.text)
            parts.append("| " + " | ".join(map(str, cells)) + " |\n")
    return "".join(parts)


def as_csv() -> str:
    """Return the rows of `as_rows` as CSV; `access` is R or R/W, as in the import formats of PLC tools."""
    text = io.StringIO()
    rows = [_with_access(row) for row in as_rows()]
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_rows() -> list[dict[str, str | int | bool]]:
    """Return the map as plain values, in the order of the tables above."""
    return [
        {
            "table": _NAMES[row.table],
            "number": row.number,
            "address": row.address,
            "classic": row.classic,
            "name": row.name,
            "type": row.type.value,
            "words": row.type.words,
            "unit": row.unit,
            "scale": row.scale,
            "writable": row.writable,
            "text": row.text,
        }
        for table in _TITLES
        for row in _rows(table)
    ]


def _with_access(row: dict[str, str | int | bool]) -> dict[str, str | int | bool]:
    return {
        "access" if key == "writable" else key: value if key != "writable" else ("R/W" if value else "R")
        for key, value in row.items()
    }


def _rows(table: RegisterTable) -> list[Register]:
    return sorted((row for row in MAP if row.table is table), key=lambda row: row.number)
