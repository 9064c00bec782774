"""Entry point of `hilrig` and `python -m hilrig_cli`: runs a command and ends with its exit code."""

import sys
from typing import TYPE_CHECKING, Any, Final, NoReturn

from hilrig_cli.extras import smallest_extra
from hilrig_runtime.errors import InputError, OperationError, install_command
from hilrig_runtime.process.shutdown import run_process

if TYPE_CHECKING:
    import typer

_OWN_PACKAGE_PREFIX: Final = "hilrig"
"""Prefix of hilrig's own packages, which every installation has."""


def main() -> NoReturn:
    """Run the `hilrig` command, and end the process with its exit code."""
    run_process(_command)


def _command() -> int:
    # Imported here: the import takes a moment, in which Ctrl-C must work.
    import typer

    from hilrig_cli.main import app

    # The base of all usage errors has no public name.
    usage_error: Any = typer.BadParameter.__bases__[0]
    try:
        return int(app(prog_name="hilrig", standalone_mode=False) or 0)
    except usage_error as error:
        if not (getattr(error, "message", "") or getattr(error, "param", None)):
            # A group without a command shows its help.
            error.show()
            return InputError.exit_code
        raise InputError(_usage_text(error)) from error
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(_OWN_PACKAGE_PREFIX):
            raise
        command = next((argument for argument in sys.argv[1:] if not argument.startswith("-")), "")
        missing = error.name.partition(".")[0]
        fix = f"run in hilrig's folder: {install_command(smallest_extra(command))}"
        raise OperationError(f"`hilrig {command}` needs {missing!r}, which is not installed: {fix}") from error


def _usage_text(error: "typer.BadParameter") -> str:
    """Return a usage error as one line: option or argument, value found, accepted values, and the help."""
    from pydantic import ValidationError

    from hilrig_runtime.config.validation import format_validation_error

    path = "hilrig" if error.ctx is None else error.ctx.command_path
    param = getattr(error, "param", None)
    if isinstance(error.__cause__, ValidationError) and param is not None:
        name = param.get_error_hint().strip("'")
        sentences = (sentence.rstrip(".") for sentence in format_validation_error(error.__cause__))
        return f"{name}: {'; '.join(sentences)}; see {path} --help"
    text = error.format_message().rstrip(".")
    return f"{text[:1].lower()}{text[1:]}; see {path} --help"


if __name__ == "__main__":
    main()
