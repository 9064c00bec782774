import csv
import io
import json
from pathlib import Path

from hilrig_modbus_edge.registers import export
from hilrig_modbus_edge.registers.map import MAP
from support.labs import hilrig

PAGE = Path(__file__).parents[2] / "docs/registers.md"


def test_registers_page_equals_the_map() -> None:
    assert PAGE.read_text() == export.as_markdown(), "run: hilrig registers --markdown > docs/registers.md"


def test_csv_has_every_value_of_the_map() -> None:
    rows = list(csv.DictReader(io.StringIO(export.as_csv())))
    assert {row["name"] for row in rows} == {register.name for register in MAP}
    theta1 = next(row for row in rows if row["name"] == "theta1")
    assert (theta1["table"], theta1["number"], theta1["address"], theta1["classic"]) == (
        "holding register",
        "5",
        "4",
        "40005",
    )
    assert (theta1["type"], theta1["unit"], theta1["scale"], theta1["access"]) == ("int16", "°", "100", "R")
    access = {row["name"]: row["access"] for row in rows}
    assert access == {register.name: "R/W" if register.writable else "R" for register in MAP}


def test_command_prints_the_map_in_each_format() -> None:
    assert hilrig("registers", "--csv").stdout == export.as_csv()
    assert hilrig("registers", "--markdown").stdout == export.as_markdown()
    rows = json.loads(hilrig("registers", "--json").stdout)
    assert rows == [{"schema": "hilrig.registers/1", **row} for row in export.as_rows()]
    assert "theta1" in hilrig("registers").stdout
