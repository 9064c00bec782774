"""`hilrig registers`: prints the register map of a rig as a table, CSV, Markdown or JSON."""

from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def registers(
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV for import into a PLC tool.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown, as in docs/registers.md.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print the register map: every register and coil of a rig with its type, unit, scale and meaning."""
    from hilrig_cli.json_output.lab import RegistersOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_modbus_edge.registers import export

    if as_csv:
        print(export.as_csv(), end="")
    elif as_markdown:
        print(export.as_markdown(), end="")
    elif as_json:
        print_json([RegistersOutput.model_validate(row) for row in export.as_rows()])
    else:
        _print_table(export.as_rows())


def _print_table(rows: list[dict[str, str | int | bool]]) -> None:
    from rich.table import Table

    from hilrig_cli.terminal import TerminalConsole

    table = Table("table", "number", "address", "name", "type", "unit", "scale", "written by", "meaning")
    for row in rows:
        table.add_row(
            *(str(row[key]) for key in ("table", "number", "address", "name", "type", "unit", "scale")),
            "controller" if row["writable"] else "rig",
            str(row["text"]),
        )
    TerminalConsole().print(table)
