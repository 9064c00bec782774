"""`hilrig join`: joins the segments of a session."""

from pathlib import Path
from typing import Annotated

import typer


def join(
    segments: Annotated[
        list[Path], typer.Argument(metavar="RUN.MCAP", help="All segments of one session, in any order.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write; it must not exist.", show_default=False)],
) -> None:
    """Write the segments of a session as one recording, for example after a restart of the recorder.

    The segments are kept. Their losses are added, and messages that two of them contain are written once.
    """
    from hilrig_replay.export.join import join as join_segments
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.escaping import printable

    if len(segments) < 2:
        raise InputError(f"expected two or more segments, got {len(segments)}")
    messages = join_segments(segments, out)
    print(printable(f"{out}: joined {messages} messages of {len(segments)} segments"))
