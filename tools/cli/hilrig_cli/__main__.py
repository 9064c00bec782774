"""`hilrig` and `python -m hilrig_cli`: a command, and how its process ends."""

import sys

from hilrig_runtime.ending import run_main


def main() -> int:
    """Entry point of the `hilrig` command; gives the exit code."""
    return run_main(_command)


def _command() -> None:
    # Here, because it takes a moment in which Ctrl-C may come.
    from hilrig_cli.main import app

    app()


if __name__ == "__main__":
    sys.exit(main())
