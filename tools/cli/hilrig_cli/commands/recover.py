"""`hilrig recover`: recovers truncated or damaged MCAP files."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_recorder.mcap_format.recover import Recovery


def recover(
    files: Annotated[
        list[Path], typer.Argument(metavar="RUN.MCAP", help="MCAP files, of hilrig or of other programs.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Path of the recovered file; for one input file only.", show_default=False),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write complete, indexed files from truncated or damaged ones; originals are kept until the new files are stored.

    `RUN.mcap.part` becomes `RUN.mcap`; any other file is recovered to a new `.recovered.mcap` file in the same folder.
    Exit code 1: data was lost, or one of several files can't be recovered.
    """
    from dataclasses import asdict

    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import RecoverOutput
    from hilrig_recorder.mcap_format.file_names import PART_SUFFIX, recovered_path
    from hilrig_recorder.mcap_format.recover import recover as recover_file
    from hilrig_runtime.errors import HilrigError, InputError
    from hilrig_runtime.escaping import printable

    if output is not None and len(files) > 1:
        raise InputError(f"--out: expected one input file, got {len(files)}")
    recoveries, failed = [], []
    for source in files:
        try:
            recovery = recover_file(source, output or recovered_path(source))
        except HilrigError as error:
            # A file of several that can't be recovered is reported in its own line.
            if len(files) == 1:
                raise
            failed.append(str(error))
            print(printable(str(error)), file=sys.stderr)
            continue
        if recovery.path is not None and output is None and source.name.endswith(PART_SUFFIX):
            source.unlink()
        recoveries.append(recovery)
        if not as_json:
            _print(recovery)
    if as_json:
        print_json(
            [
                RecoverOutput.model_validate(
                    asdict(one) | {"source": str(one.source), "path": None if one.path is None else str(one.path)}
                )
                for one in recoveries
            ]
        )
    if failed or any(recovery.damaged_bytes or recovery.orphans for recovery in recoveries):
        raise typer.Exit(1)


def _print(recovery: "Recovery") -> None:
    from hilrig_runtime.escaping import printable

    if recovery.path is None:
        print(printable(f"{recovery.source}: complete; nothing to do"))
        return
    written = f"recovered {recovery.messages} messages in {recovery.chunks} chunks"
    print(printable(f"{recovery.source} -> {recovery.path}: {written}"))
    if recovery.damaged_bytes or recovery.orphans:
        print(
            f"  lost: {recovery.damaged_bytes} bytes, {recovery.damaged_chunks} damaged chunks, "
            f"{recovery.orphans} messages of unknown channels"
        )
        for reason in recovery.reasons[:10]:
            print(f"  {printable(reason)}")
