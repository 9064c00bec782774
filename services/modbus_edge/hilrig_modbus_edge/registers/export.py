"""The register map as tables: Markdown for `docs/registers.md`, CSV for PLC tools, rows for programs."""

import csv
import io
from typing import Final

from hilrig_modbus_edge.registers.map import MAP, UNIT_IDS, Register, Table

_TITLES: Final = {
    Table.HOLDING_REGISTER: ("Holding registers", "read with 3, written with 6, 16, 22 and 23"),
    Table.COIL: ("Coils", "read with 1, written with 5 and 15"),
    Table.INPUT_REGISTER: ("Input registers", "read with 4"),
    Table.DISCRETE_INPUT: ("Discrete inputs", "read with 2"),
}
_NAMES: Final = {
    Table.HOLDING_REGISTER: "holding register",
    Table.COIL: "coil",
    Table.INPUT_REGISTER: "input register",
    Table.DISCRETE_INPUT: "discrete input",
}

_INTRODUCTION: Final = """# Registers

Generated from `hilrig_modbus_edge/registers/map.py` by `hilrig registers --markdown`; `hilrig registers --csv` prints
the same for import into a PLC tool.

Each rig has a TCP port of its own. Number n of a table is address n - 1 in a request, and PLC tools call holding
register 1 "40001". Values are big-endian; a value of two registers has the more significant one first. A register
with a scale holds the value times that: -12.34° at scale 100 is -1234.

Holding registers 1-8 and coil 1 are the map of the paper; a controller needs nothing else. A block read shows one step
of the simulation: no value is torn, no two values are of different steps. A block write is done whole or not at all.
Reading or writing what is not in these tables gets exception 02, and so does writing what the rig owns. A watchdog
time-out outside the lab's bounds gets exception 04. Positions get exception 04 until the simulation has spoken.
"""


def as_markdown() -> str:
    """The page `docs/registers.md`."""
    parts = [_INTRODUCTION]
    units = ", ".join(str(unit) for unit in sorted(UNIT_IDS))
    parts.append(f"\nUnit identifiers {units} are answered; others get exception 0B.\n")
    for table, (title, functions) in _TITLES.items():
        parts.append(f"\n## {title}\n\nFunctions: {functions}.\n")
        parts.append("\n| number | address | name | type | unit | scale | written by | what it is |")
        parts.append("\n|---:|---:|---|---|---|---:|---|---|\n")
        for row in _rows(table):
            last = row.number + row.kind.words - 1
            number = str(row.number) if last == row.number else f"{row.number}-{last}"
            scale = str(row.scale) if row.scale > 1 else ""
            owner = "controller" if row.writable else "rig"
            cells = (number, row.address, f"`{row.name}`", row.kind.value, row.unit, scale, owner, row.text)
            parts.append("| " + " | ".join(map(str, cells)) + " |\n")
    return "".join(parts)


def as_csv() -> str:
    """One line a value, as `as_rows`; but `access` is R or R/W, as manuals and import formats of PLC tools have it."""
    text = io.StringIO()
    rows = [_with_access(row) for row in as_rows()]
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_rows() -> list[dict[str, str | int | bool]]:
    """The map as plain values, in the order of the tables above."""
    return [
        {
            "table": _NAMES[row.table],
            "number": row.number,
            "address": row.address,
            "classic": row.classic,
            "name": row.name,
            "type": row.kind.value,
            "words": row.kind.words,
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


def _rows(table: Table) -> list[Register]:
    return sorted((row for row in MAP if row.table is table), key=lambda row: row.number)
