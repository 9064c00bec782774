"""`hilrig verify`: is a recording what the model makes of its efforts?"""

import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def verify(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP…", help="Recordings, or folders of recordings.", show_default=False),
    ],
    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Deviation allowed, rad or m and their rates; default: none where it was recorded on a machine like "
            "this one, else 1e-9.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Re-simulate recordings from their efforts and compare every state; the verdict is kept beside each file.

    Exit code 1: a recording (or one of them) is not what the model makes of its efforts.
    """
    from rich.console import Console
    from rich.text import Text

    from hilrig_replay.analysis.index import write_verdict
    from hilrig_replay.analysis.verify import verify as resimulate
    from hilrig_replay.io.paths import find_recordings

    console = Console()
    found = []
    for path in find_recordings(runs):
        verification = resimulate(path, tolerance)
        # A note for the list of runs; in a folder that can't be written there is none.
        with suppress(OSError):
            write_verdict(path, verification.same, verification.sentence())
        found.append(verification)
        if not as_json:
            style = "green" if verification.same else "red"
            console.print(Text(f"{path.name}: {verification.sentence()}", style=style), soft_wrap=True)
    if as_json:
        plain = [each.as_dict() for each in found]
        print(json.dumps(plain[0] if len(plain) == 1 else {"runs": plain}))
    if not all(each.same for each in found):
        raise typer.Exit(1)
