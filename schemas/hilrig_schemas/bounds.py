"""Bounds of every value in a received message, checked once, where the message is decoded (`Topic.decode`).

A certified peer may send any value that protobuf can encode. Without bounds a negative time or a sequence number of
2^63 ends the receiver where it computes with it or encodes it again. The bounds are of names of fields, so that a new
field has one without further code. Batches and their content are checked by their own decoders, which are faster:
`LatestValueCache`, `CommandLatch`, `StateImage` and `decode_batch`.
"""

from math import isfinite
from typing import Final

from google.protobuf.message import DecodeError, Message

MAX_INTEGER: Final = (1 << 62) - 1
"""Largest number in a message; as a time, ns since 1970, in the year 2116. Sums and differences fit into 64 bits."""
MAX_SEQUENCE: Final = (1 << 48) - 1
"""Largest sequence number; at a thousand messages a second it is reached after nine thousand years."""
MAX_ITEMS: Final = 4096
"""Maximum number of items of a repeated field, as rigs, sessions or requests."""
MAX_TEXT: Final = 4096
"""Maximum length of a text, characters."""
MAX_DOCUMENT: Final = 1 << 20
"""Maximum length of a text in `DOCUMENTS`, characters."""
MAX_SESSION_ID: Final = 128
"""Maximum length of the id of a session, characters."""

SIGNED: Final = frozenset(
    {"clock_offset_ns", "lateness_ns", "lateness_p50_ns", "lateness_p99_ns", "lateness_max_ns", "silent_ns"}
)
"""Integer fields that may be negative."""
DOCUMENTS: Final = frozenset({"parameters_json", "urdf", "lab_toml", "settings_json", "set_json", "links_json", "text"})
"""Text fields that may contain a file or a configuration."""
_ITEMS_OF: Final = {"loop_us": 1 << 16, "age_us": 1 << 16}


def check_bounds(message: Message) -> None:
    """Check every value of a message, also in messages that it contains.

    Raises:
        DecodeError: a value is out of its bounds; contains the name of the field.
    """
    for field, value in message.ListFields():
        name = field.name
        if isinstance(value, (int, float, str, bytes, Message)):
            _check_value(name, value)
            continue
        if len(value) > _ITEMS_OF.get(name, MAX_ITEMS):
            raise DecodeError(f"{name} has {len(value)} items")
        for item in value:
            _check_value(name, item)


def _check_value(name: str, value: object) -> None:
    if isinstance(value, Message):
        check_bounds(value)
    elif isinstance(value, int):
        if not (-MAX_INTEGER if name in SIGNED else 0) <= value <= MAX_INTEGER:
            raise DecodeError(f"{name} is {value}")
    elif isinstance(value, float):
        if not isfinite(value):
            raise DecodeError(f"{name} is {value}")
    elif isinstance(value, str) and len(value) > (MAX_DOCUMENT if name in DOCUMENTS else MAX_TEXT):
        raise DecodeError(f"{name} has {len(value)} characters")
