"""The extras of the distribution, each with the commands that it installs the dependencies of."""

from typing import Final

COMMANDS: Final = {
    "": "certs check claim example ik registers",
    "rig": "doctor edge events impair lease metrics record recorder rig router sim top up",
    "review": "compare export grade join latency live play recover replay report runs verify",
    "console": "console",
    "study": "assign demo jitter study",
}
"""Names of the commands, by the smallest extra that has all they need; the base installation has the extra `""`."""


def smallest_extra(command: str) -> str:
    """Return the smallest extra with all dependencies of a command; `all` for an unknown one."""
    return next((extra for extra, commands in COMMANDS.items() if command in commands.split()), "all")
