"""`hilrig` and `python -m hilrig_cli`: a command, and how its process ends."""

import sys
from typing import Final

from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.shutdown import run_main

_OUR_OWN: Final = "hilrig"
"""What begins so is in every installation."""


def main() -> int:
    """Entry point of the `hilrig` command; gives the exit code."""
    return run_main(_command)


def _command() -> None:
    # Here, because it takes a moment in which Ctrl-C may come.
    from hilrig_cli.main import app

    try:
        app()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(_OUR_OWN):
            raise
        package = error.name.partition(".")[0]
        raise OperationError(
            f"this command needs {package!r}, which is not installed here, for only some of hilrig's parts are: "
            "pip install 'hilrig[all]'"
        ) from error


if __name__ == "__main__":
    sys.exit(main())
