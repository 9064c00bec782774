"""Number formats of a controller's registers."""

import math
import struct

import pytest

from hilrig_modbus_edge.client.value_format import ValueFormat
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_runtime.config.controller import RegistersConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import JointState

POSITION = (math.radians(12.34), math.radians(-400.0), 0.05678, math.radians(90.0))


def image() -> StateImage:
    image = StateImage()
    zero = (0.0,) * 4
    assert image.update(
        TimestampedPayload(JointState(position=POSITION, velocity=zero, effort=zero).SerializeToString(), 1)
    )
    return image


def value_format(form: str, order: str = "high-first") -> ValueFormat:
    wide = {"positions": 20} if form != "int16" else {}
    return ValueFormat(RegistersConfig.model_validate({"format": form, "word_order": order, **wide}))


def test_int16_is_the_format_of_the_rig_itself() -> None:
    assert struct.unpack(">4h", value_format("int16").positions(image())) == (1234, -32767, 5678, 9000)
    assert value_format("int16").torques(struct.pack(">4h", 1, -2, 3, -4)) == struct.pack(">4h", 1, -2, 3, -4)


def test_32_bit_values_in_both_word_orders() -> None:
    counts = (1234, -40_000, 5678, 9000)
    assert struct.unpack(">4i", value_format("int32").positions(image())) == counts
    low_first = value_format("int32", "low-first").positions(image())
    assert low_first[:4] == struct.pack(">HH", 1234, 0)
    floats = struct.unpack(">4f", value_format("float32").positions(image()))
    assert floats == pytest.approx((12.34, -400.0, 56.78, 90.0), rel=1e-6)


@pytest.mark.parametrize("order", ["high-first", "low-first"])
def test_32_bit_torques_saturate_at_the_registers_of_the_rig(order: str) -> None:
    def words(code: str, *values: float) -> bytes:
        packed = struct.pack(f">4{code}", *values)
        if order == "low-first":
            packed = b"".join(packed[at + 2 : at + 4] + packed[at : at + 2] for at in range(0, 16, 4))
        return packed

    integers = value_format("int32", order).torques(words("i", 1500, -2, 40_000, 0))
    assert struct.unpack(">4h", integers) == (1500, -2, 32_767, 0)
    floats = value_format("float32", order).torques(words("f", 1.5, -0.002, -1e30, math.nan))
    assert struct.unpack(">4h", floats) == (1500, -2, -32_767, 0)
