"""How a recording ended: values of `ended` in its metadata record `hilrig.summary`."""

from enum import StrEnum


class Ending(StrEnum):
    """The causes, which docs/recordings.md explains."""

    ENDED = "ended"
    CONTINUED = "continued"
    RECORDER_STOPPED = "recorder stopped"
    OWNER_LOST = "keeper lost"
    DISK_FULL = "disk full"
    WRITE_FAILED = "write failed"
    RECOVERED = "recovered"
