"""`hilrig report`: runs as one page to read, print or hand in."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP…", help="Recordings, or folders of recordings.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The page to write.")] = Path("report.html"),
    verify: Annotated[
        bool, typer.Option("--verify", help="Re-simulate each run, and say whether it is the same.")
    ] = False,
) -> None:
    """Write one HTML page of a run, or of a class of runs, ranked: motion, task, latency, events; no network needed."""
    from hilrig_replay.report import report_html
    from hilrig_replay.run import open_run
    from hilrig_replay.selection import recordings
    from hilrig_runtime.errors import InputError, OperationError

    if not out.parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.parent}")
    page = report_html([open_run(path) for path in recordings(runs)], verified=verify)
    try:
        out.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OperationError(f"{out}: can't be written: {error.strerror or error}") from error
    print(out)
