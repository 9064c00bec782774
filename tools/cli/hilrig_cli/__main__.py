"""Entry point of `hilrig` and `python -m hilrig_cli`: runs a command and returns its exit code."""

import sys
from typing import Final

from hilrig_cli.extras import smallest_extra
from hilrig_runtime.errors import OperationError, install_command
from hilrig_runtime.process.shutdown import run_main

_OWN_PACKAGE_PREFIX: Final = "hilrig"
"""Prefix of hilrig's own packages, which every installation has."""


def main() -> int:
    """Run the `hilrig` command; return the exit code."""
    return run_main(_command)


def _command() -> None:
    # Imported here: the import takes a moment, in which Ctrl-C must work.
    from hilrig_cli.main import app

    try:
        app()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(_OWN_PACKAGE_PREFIX):
            raise
        command = next((argument for argument in sys.argv[1:] if not argument.startswith("-")), "")
        missing = error.name.partition(".")[0]
        fix = f"run in hilrig's folder: {install_command(smallest_extra(command))}"
        raise OperationError(f"`hilrig {command}` needs {missing!r}, which is not installed: {fix}") from error


if __name__ == "__main__":
    sys.exit(main())
