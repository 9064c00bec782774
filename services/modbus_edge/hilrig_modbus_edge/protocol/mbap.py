"""MBAP framing of Modbus TCP: decodes the requests in a byte stream and encodes responses.

The header has seven bytes: transaction identifier, protocol identifier (0), length of the remainder, unit identifier.
An invalid length or another protocol identifier means that the stream is out of step. Its further bytes are not valid,
so the connection is closed (MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 4.3.2 and 4.4.2).
"""

import struct
from typing import Final, NamedTuple

HEADER: Final = struct.Struct(">HHHB")
MIN_LENGTH: Final = 2
"""Unit identifier and function code, bytes."""
MAX_LENGTH: Final = 254
"""Unit identifier and the longest PDU (253 bytes), bytes."""
MIN_FRAME: Final = 6 + MIN_LENGTH
MAX_FRAME: Final = 6 + MAX_LENGTH


class Request(NamedTuple):
    """One decoded request."""

    transaction: int
    unit: int
    pdu: bytes
    """Function code and data, 1 to 253 bytes."""


class DecodedFrames(NamedTuple):
    """Result of decoding a buffer."""

    requests: list[Request]
    used: int
    """Number of bytes of these requests; the remainder is an incomplete or malformed request."""
    malformed: str
    """Human-readable defect of the remainder; empty: it is valid so far."""


def decode_frames(data: bytes, limit: int) -> DecodedFrames:
    """Decode the complete requests of `data`, in order, at most `limit`."""
    requests: list[Request] = []
    start, size = 0, len(data)
    while size - start > 6:
        if len(requests) == limit:
            return DecodedFrames(requests, start, "")
        transaction, protocol, length, unit = HEADER.unpack_from(data, start)
        end = start + 6 + length
        if protocol or not MIN_LENGTH <= length <= MAX_LENGTH:
            break
        if end > size:
            return DecodedFrames(requests, start, "")
        requests.append(Request(transaction, unit, data[start + 7 : end]))
        start = end
    return DecodedFrames(requests, start, _defect(data[start : start + 6]))


def encode_frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Encode one message with its header."""
    return HEADER.pack(transaction, 0, len(pdu) + 1, unit) + pdu


def _defect(header: bytes) -> str:
    # Reported as soon as the bytes are received: the remainder of a malformed request may never arrive.
    if any(header[2:4]):
        return f"protocol identifier 0x{header[2:4].hex()} in the MBAP header, expected 0"
    if len(header) >= 6 and not MIN_LENGTH <= int.from_bytes(header[4:6], "big") <= MAX_LENGTH:
        return f"length {int.from_bytes(header[4:6], 'big')} in the MBAP header, expected {MIN_LENGTH} to {MAX_LENGTH}"
    return ""
