"""Exports the register map: Markdown for `docs/registers.md`, CSV for PLC tools, rows for programs."""

import csv
import io
from typing import Final

from hilrig_modbus_edge.protocol.functions import FunctionCode, RegisterTable
from hilrig_modbus_edge.registers.map import UNIT_IDS, rows_of

TABLE_NAMES: Final = {
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
a read-only register; with `unmapped_reads = "zeros"` in `[edge]`, the missing addresses of a block read 0. For
controllers with functions 3, 6, 16 and 23 only, holding registers 201-236 repeat the input registers, 301 the magnet
and 302 the reset. A watchdog timeout outside the bounds of the lab gets exception 04. A read of a position gets
exception 04 until the simulation has published its first state. In a class with claims, holding registers 401-405 take
a student's code ([classroom](classroom.md)).
"""


def as_markdown() -> str:
    """Return the page `docs/registers.md`."""
    parts = [_INTRODUCTION]
    units = ", ".join(str(unit) for unit in sorted(UNIT_IDS))
    parts.append(f"\nAccepted unit identifiers: {units}; a request to another one gets exception 0B.\n")
    for table, name in TABLE_NAMES.items():
        parts.append(f"\n## {name.capitalize()}s\n\nFunctions: {_functions(table)}.\n")
        parts.append("\n| number | address | name | type | unit | scale | written by | description |")
        parts.append("\n|---:|---:|---|---|---|---:|---|---|\n")
        for row in rows_of(table):
            number = str(row.number) if row.type.words == 1 else f"{row.number}-{row.end}"
            scale = str(row.scale) if row.scale > 1 else ""
            owner = "controller" if row.writable else "rig"
            cells = (number, row.address, f"`{row.name}`", row.type.name.lower(), row.unit, scale, owner, row.text)
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
            "table": TABLE_NAMES[row.table],
            "number": row.number,
            "address": row.address,
            "classic": row.classic,
            "name": row.name,
            "type": row.type.name.lower(),
            "words": row.type.words,
            "unit": row.unit,
            "scale": row.scale,
            "writable": row.writable,
            "text": row.text,
        }
        for table in TABLE_NAMES
        for row in rows_of(table)
    ]


def _with_access(row: dict[str, str | int | bool]) -> dict[str, str | int | bool]:
    return {
        "access" if key == "writable" else key: value if key != "writable" else ("R/W" if value else "R")
        for key, value in row.items()
    }


def _functions(table: RegisterTable) -> str:
    """Return the functions that access a table: "read with 1, written with 5 and 15"."""
    mine = [function for function in FunctionCode if function.table is table]
    reads, writes = [f for f in mine if f.is_read], [f for f in mine if f.is_write]
    parts = [f"{verb} with {_join(codes)}" for verb, codes in (("read", reads), ("written", writes)) if codes]
    return ", ".join(parts)


def _join(codes: list[FunctionCode]) -> str:
    return " and ".join(", ".join(map(str, part)) for part in (codes[:-1], codes[-1:]) if part)
