"""Random protobuf messages with extreme values, for fuzz tests of every type on the bus."""

import random
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

_INTEGERS: dict[int, tuple[int, ...]] = {
    FieldDescriptor.CPPTYPE_INT32: (-(1 << 31), -1, 0, 1, (1 << 31) - 1),
    FieldDescriptor.CPPTYPE_UINT32: (0, 1, (1 << 32) - 1),
    FieldDescriptor.CPPTYPE_INT64: (-(1 << 63), -1, 0, 1, 1_700_000_000_000_000_000, (1 << 62), (1 << 63) - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 1, 1_700_000_000_000_000_000, 1 << 48, 1 << 63, (1 << 64) - 1),
    FieldDescriptor.CPPTYPE_ENUM: (-1, 0, 1, 2, 99),
}
_FLOATS = (0.0, -1.0, 1e308, float("nan"), float("inf"), float("-inf"))


def random_message(rng: random.Random, kind: type[Message], names: tuple[str, ...], depth: int = 0) -> Any:
    """Return a message with random values in some of its fields; `names` are used in texts."""
    message: Any = kind()
    for field in kind.DESCRIPTOR.fields:
        if rng.random() < 0.3:
            continue
        value = getattr(message, field.name)
        if hasattr(value, "extend"):
            for _ in range(rng.choice((0, 1, 4, 7))):
                if field.message_type is not None:
                    if depth < 3:
                        part = value.add()
                        part.CopyFrom(random_message(rng, type(part), names, depth + 1))
                else:
                    value.append(_random_value(rng, field.cpp_type, field.type, names))
        elif field.message_type is not None:
            if depth < 3:
                value.CopyFrom(random_message(rng, type(value), names, depth + 1))
        else:
            setattr(message, field.name, _random_value(rng, field.cpp_type, field.type, names))
    return message


def random_bytes(rng: random.Random, payload: bytes) -> bytes:
    """Return the payload, sometimes with changed or missing bytes."""
    if rng.random() < 0.7 or not payload:
        return payload
    changed = bytearray(payload)
    for _ in range(rng.randrange(1, 4)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed[: rng.randrange(len(changed) + 1)]) if rng.random() < 0.3 else bytes(changed)


def _random_value(rng: random.Random, cpp_type: int, field_type: int, names: tuple[str, ...]) -> Any:
    if cpp_type in _INTEGERS:
        return rng.choice(_INTEGERS[cpp_type])
    if cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return rng.random() < 0.5
    if field_type == FieldDescriptor.TYPE_BYTES:
        return rng.randbytes(rng.randrange(40))
    if cpp_type == FieldDescriptor.CPPTYPE_STRING:
        return rng.choice((*names, "", "../x", "x" * 5_000, "\u2028{}[]%s"))
    return rng.choice(_FLOATS)
