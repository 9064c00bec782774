"""`hilrig example`: lists the examples, or writes one."""

from pathlib import Path
from typing import Annotated

import typer


def example(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="File or folder; without it, all examples are listed.")
    ] = "",
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to write to.")] = Path(),
) -> None:
    """List the example controllers, lab files and exercises, or write one into a folder."""
    import shutil

    from rich.table import Table

    from hilrig_cli.examples import example_path, listed_names, summary
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_runtime.errors import InputError, OperationError

    if not name:
        table = Table(box=None, header_style="bold")
        table.add_column("example", overflow="fold")
        table.add_column("content", ratio=1)
        for known in listed_names():
            table.add_row(known, summary(known))
        TerminalConsole().print(table)
        return
    try:
        source = example_path(name)
    except LookupError as error:
        raise InputError(str(error.args[0])) from error
    target = out / source.name
    if target.exists() or target.is_symlink():
        raise InputError(f"{target}: exists already, and is not replaced; choose another folder with --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
        else:
            shutil.copyfile(source, target)
    except FileExistsError as error:
        raise OperationError(f"{out}: expected a folder, found a file") from error
    except OSError as error:
        raise OperationError(f"{target}: can't be written: {error.strerror}") from error
    print(target)
