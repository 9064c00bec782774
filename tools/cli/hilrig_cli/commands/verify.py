"""`hilrig verify`: re-simulates recordings and compares every state."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def verify(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP", help="Recordings, or folders of recordings."),
    ],
    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Allowed deviation of positions (rad, m) and velocities; default: 0 if it was recorded on an equal "
            "platform, otherwise 1e-9.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Re-simulate recordings from their torques and compare every state; the verdict is stored next to each file.

    Exit code 1: re-simulation does not reproduce at least one recording, or one of several can't be read.
    """
    from rich.text import Text

    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import VerifyOutput, VerifyRunsOutput
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_replay.analysis.index import write_verdict
    from hilrig_replay.analysis.verify import verify as resimulate
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_runs
    from hilrig_runtime.errors import HilrigError
    from hilrig_runtime.escaping import printable

    console = TerminalConsole()
    verifications, unreadable = [], []
    found = find_runs(runs)
    for files in found:
        path = files[0]
        try:
            with isolated(path):
                verification = resimulate(files, tolerance)
        except HilrigError as error:
            # An unreadable recording of several is reported in its own line.
            if len(found) == 1:
                raise
            unreadable.append({"path": str(path), "reason": str(error)})
            print(printable(str(error)), file=sys.stderr)
            continue
        # The verdict is shown by `hilrig runs`; in a read-only folder it is not stored.
        with suppress(OSError, HilrigError):
            write_verdict(files, verification.same, verification.sentence())
        verifications.append(verification)
        if not as_json:
            style = "green" if verification.same else "red"
            console.print(Text(f"{path.name}: {verification.sentence()}", style=style), soft_wrap=True)
    if as_json:
        every = [each.as_dict() for each in verifications]
        if len(found) == 1:
            print_json(VerifyOutput.model_validate(every[0]))
        else:
            print_json(VerifyRunsOutput.model_validate({"runs": every, "unreadable": unreadable}))
    if unreadable or not all(each.same for each in verifications):
        raise typer.Exit(1)
