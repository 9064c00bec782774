"""The two ways in which a command fails, each with its exit code.

Errors are raised where they are found, say what was wrong, where, and what would be right, and are caught once, at
the process's edge (`lifecycle.run_main`).
"""


class HilrigError(Exception):
    """Something that a person should read as one clear line, without a traceback."""

    exit_code = 3


class InputError(HilrigError):
    """What was given is wrong: an option, a configuration, a file. Exit code 2."""

    exit_code = 2


class OperationError(HilrigError):
    """What was asked for is right, but could not be done: a port in use, a disk full. Exit code 3."""

    exit_code = 3
