"""Recognizes other protocols in the data of a client that is not Modbus TCP, for messages. Pure functions."""

from typing import Final, NamedTuple

MAX_RTU_FRAME: Final = 256
"""Unit identifier, the longest PDU and CRC-16, bytes."""
_MIN_RTU_FRAME: Final = 4
_SHOWN: Final = 12
"""Number of bytes that a message shows."""
_METHODS: Final = (b"GET ", b"HEAD ", b"POST ", b"PUT ", b"OPTIONS ", b"CONNECT ", b"PRI * HTTP")
_HEX: Final = frozenset(b"0123456789ABCDEFabcdef")


class Foreign(NamedTuple):
    """Data that was received instead of Modbus TCP."""

    name: str
    fix: str


def foreign_protocol(data: bytes | bytearray) -> Foreign | None:
    """Return the protocol that the data begins with; None: unknown."""
    if data[:1] == b":" and len(data) > 2 and _HEX.issuperset(data[1:].rstrip(b"\r\n")):
        return Foreign("Modbus ASCII", "select Modbus TCP in the client, not ASCII over TCP")
    if data[:2] == b"\x16\x03":
        return Foreign("TLS", "connect without TLS, or to the TLS port of the rig (edge.tls in lab.toml)")
    if data.startswith(_METHODS):
        return Foreign("HTTP", "this is the Modbus port of a rig; hilrig console serves the web page")
    if _begins_with_rtu_frame(data):
        return Foreign("Modbus RTU with CRC-16", "select Modbus TCP in the client, not RTU over TCP")
    return None


def first_bytes(data: bytes | bytearray) -> str:
    """Return the first bytes in hex, for a message."""
    more = " …" if len(data) > _SHOWN else ""
    return f"first bytes {data[:_SHOWN].hex(' ')}{more}"


def _begins_with_rtu_frame(data: bytes | bytearray) -> bool:
    """Return whether the data begins with a frame of any length whose CRC-16 is valid.

    The CRC of Modbus over Serial Line V1.02, 6.2.2; over a frame with its own CRC it is 0.
    """
    crc = 0xFFFF
    for count, byte in enumerate(data[:MAX_RTU_FRAME], 1):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
        if not crc and count >= _MIN_RTU_FRAME:
            return True
    return False
