"""Runs `hilrig` commands in the process of the test: a test of many commands imports their modules once."""

import io
import subprocess
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

from hilrig_runtime.process.shutdown import run_main
from support.json_output import check_json_output


@cache
def _main() -> Any:
    from typer.main import get_command

    from hilrig_cli.main import app

    return get_command(app)


def hilrig_in_process(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command with standard output and error in UTF-8, as in a process of its own; an error is raised.

    The output of a command with `--json` is checked against its published schema.
    """
    command, main = list(map(str, arguments)), _main()
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = run_main(lambda: main(command, prog_name="hilrig"))
        except SystemExit as ending:
            code = int(ending.code or 0)
    for stream in (out, err):
        stream.seek(0)
    done = subprocess.CompletedProcess(command, code, out.read(), err.read())
    if "--json" in command and code in (0, 1):
        check_json_output(command, done.stdout)
    return done
