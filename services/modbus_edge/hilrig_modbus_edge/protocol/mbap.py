"""Requests out of a stream of bytes: the MBAP header of Modbus TCP, and nothing else.

A header is seven bytes: transaction, protocol (0), length of what follows the length field, unit. A length that no
request can have, or another protocol, means that the stream is out of step: it can't be trusted any more, so its
connection is closed (MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 4.3.2 and 4.4.2).
"""

import struct
from typing import Final, NamedTuple

HEADER: Final = struct.Struct(">HHHB")
MIN_LENGTH: Final = 2
"""Unit and function code."""
MAX_LENGTH: Final = 254
"""Unit and the longest PDU, 253 bytes."""
MIN_FRAME: Final = 6 + MIN_LENGTH
MAX_FRAME: Final = 6 + MAX_LENGTH


class Request(NamedTuple):
    """One request as it stood in the stream."""

    transaction: int
    unit: int
    pdu: bytes
    """Function code and data, 1 to 253 bytes."""


class Split(NamedTuple):
    """What some bytes hold."""

    requests: list[Request]
    used: int
    """Bytes that the requests took; the rest is the beginning of one, or malformed."""
    malformed: str
    """Why the stream can't be trusted behind these requests, for people; empty: it can."""


def split(data: bytes | bytearray) -> Split:
    """Take the complete requests out of `data`, in order."""
    requests: list[Request] = []
    start, size = 0, len(data)
    while size - start > 6:
        transaction, protocol, length, unit = HEADER.unpack_from(data, start)
        end = start + 6 + length
        if protocol or not MIN_LENGTH <= length <= MAX_LENGTH:
            break
        if end > size:
            return Split(requests, start, "")
        requests.append(Request(transaction, unit, bytes(data[start + 7 : end])))
        start = end
    return Split(requests, start, _malformed(data[start : start + 6]))


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """One message with its header."""
    return HEADER.pack(transaction, 0, len(pdu) + 1, unit) + pdu


def _malformed(header: bytes | bytearray) -> str:
    # Said as soon as the bytes are there: a sender that is out of step must not be waited for.
    if any(header[2:4]):
        return "another protocol in the header; Modbus is 0"
    if len(header) >= 6 and not MIN_LENGTH <= int.from_bytes(header[4:6], "big") <= MAX_LENGTH:
        return f"length {int.from_bytes(header[4:6], 'big')} in the header; {MIN_LENGTH} to {MAX_LENGTH} is possible"
    return ""
