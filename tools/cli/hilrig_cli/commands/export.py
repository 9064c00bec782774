"""`hilrig export`: converts a recording for other tools."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN.MCAP", help="The recording.")],
    foxglove: Annotated[
        Path | None,
        typer.Option(metavar="OUT.MCAP", help="Write an MCAP file in which Foxglove and rerun show the arm."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Write tables as CSV into a folder.")] = None,
    parquet: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write tables as Parquet into a folder.")
    ] = None,
) -> None:
    """Convert a recording for other tools; print the path of each file that was written."""
    from hilrig_replay.export.export import export_foxglove, export_tables
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_run
    from hilrig_replay.io.run import open_run
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.escaping import printable

    if foxglove is None and csv is None and parquet is None:
        raise InputError("no output given: add --foxglove OUT.MCAP, --csv FOLDER or --parquet FOLDER")
    written: list[Path] = []
    with isolated(run):
        opened = open_run(find_run(run))
        if foxglove is not None:
            written.append(export_foxglove(opened, foxglove))
        for folder, kind in ((csv, "csv"), (parquet, "parquet")):
            if folder is not None:
                written += export_tables(opened, folder, kind)
    sys.stdout.writelines(f"{printable(str(path))}\n" for path in written)
