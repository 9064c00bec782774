"""`hilrig registers`: prints the register map of a rig as a table, CSV, Markdown or JSON."""

from typing import Annotated, Final

import typer

from hilrig_cli.options import AsJson

WIDE_TERMINAL_COLUMNS: Final = 100
"""Minimum width of a terminal in which the addresses are shown, characters."""


def registers(
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV for import into a PLC tool.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown, as in docs/registers.md.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print the register map: every register and coil of a rig with its type, unit, scale and meaning."""
    from hilrig_cli.json_output.lab import RegistersOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_modbus_edge.registers import export
    from hilrig_runtime.errors import InputError

    if as_csv + as_markdown + as_json > 1:
        raise InputError("--csv, --markdown and --json can't be combined: use one of them")
    if as_csv:
        print(export.as_csv(), end="")
    elif as_markdown:
        print(export.as_markdown(), end="")
    elif as_json:
        print_json([RegistersOutput.model_validate(row) for row in export.as_rows()])
    else:
        _print_table(export.as_rows())


def _print_table(rows: list[dict[str, str | int | bool]]) -> None:
    from itertools import groupby

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    console = TerminalConsole()
    keys = ("number", *(["address"] if console.width >= WIDE_TERMINAL_COLUMNS else []), "name", "type", "unit", "scale")
    for name, in_table in groupby(rows, key=lambda row: row["table"]):
        title = f"{str(name).capitalize()}s; the address in a request is the number minus 1"
        table = TerminalTable(title=title)
        for key in (*keys, "access"):
            table.add_column(key, no_wrap=True, justify="right" if key in ("number", "address", "scale") else "left")
        table.add_column("meaning", overflow="fold")
        for row in in_table:
            table.add_row(*(str(row[key]) for key in keys), "R/W" if row["writable"] else "R", str(row["text"]))
        console.print(table)
