"""`hilrig demo`: the whole rig with a controller over real Modbus TCP, then everything that a recording tells."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hilrig_cli.options import AsJson


def demo(
    duration: Annotated[float, typer.Option(min=1.0, help="How long the controller runs, seconds.")] = 20.0,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-out"),
    as_json: AsJson = False,
) -> None:
    """Run the whole rig with the example controller, then measure, verify and draw what was recorded.

    The controller, examples/pick_and_place.py, is another process that speaks Modbus TCP. Exit code 1: the loop never
    closed.
    """
    from hilrig_cli.demo import run_demo

    result = run_demo(duration, out, progress=sys.stderr.isatty() and not as_json, quiet=as_json)
    if as_json:
        print(json.dumps(_as_object(result)))
    else:
        _print(result)
    if not result.latency.samples:
        raise typer.Exit(1)


def _as_object(result: Any) -> dict[str, Any]:
    return {
        "recording": str(result.recording),
        "rrd": str(result.rrd),
        "plot": str(result.plot),
        "latency": result.latency.as_dict(),
    }


def _print(result: Any) -> None: ...
