"""Number formats of a controller's registers: the rig's own int16, or 32-bit integers and floats in either word order.

32-bit values are converted to and from the registers of the rig's map, so that both roles have the same commands.
"""

import struct
from typing import Final, Literal

from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_runtime.config.controller import RegistersConfig

_CODES: Final[dict[str, str]] = {"int16": "h", "int32": "i", "float32": "f"}
_INT32_MAX: Final = 2**31 - 1


class ValueFormat:
    """Encodes positions and decodes torques."""

    def __init__(self, registers: RegistersConfig) -> None:
        self._format: Literal["int16", "int32", "float32"] = registers.format
        self._swapped = registers.word_order == "low-first"
        self._struct = struct.Struct(f">4{_CODES[registers.format]}")
        self.size = self._struct.size
        """Bytes of four values."""

    def positions(self, image: StateImage) -> bytes:
        """Return the position registers of a state, big-endian."""
        if self._format == "int16":
            return image.position_words
        if self._format == "int32":
            counts = [round(q * scale) for q, scale in zip(image.position, codec.COUNTS_PER_UNIT, strict=True)]
            words = self._struct.pack(*(max(-_INT32_MAX, min(_INT32_MAX, count)) for count in counts))
        else:
            words = self._struct.pack(*codec.display_of(image.position))
        return _swap(words) if self._swapped else words

    def torques(self, words: bytes) -> bytes:
        """Return the torque registers of the rig's map, big-endian, of registers that were read; they saturate."""
        if self._format == "int16":
            return words
        values = self._struct.unpack(_swap(words) if self._swapped else words)
        efforts = values if self._format == "float32" else [value / codec.EFFORT_SCALE for value in values]
        return codec.words_of_effort(efforts)[0]


def _swap(words: bytes) -> bytes:
    """Exchange the two registers of each 32-bit value."""
    return b"".join(words[at + 2 : at + 4] + words[at : at + 2] for at in range(0, len(words), 4))
