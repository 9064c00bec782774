import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU

from hilrig_modbus_edge.protocol.mbap import MAX_FRAME, Request, decode_frames, encode_frame

REQUEST = st.builds(Request, st.integers(0, 65535), st.integers(0, 255), st.binary(min_size=1, max_size=253))


@given(st.lists(REQUEST, max_size=5), st.data())
def test_requests_are_decoded_from_arbitrary_segments(requests: list[Request], data: st.DataObject) -> None:
    stream = b"".join(encode_frame(*request) for request in requests)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    seen: list[Request] = []
    rest = b""
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        rest += stream[start:end]
        found = decode_frames(rest, 100)
        assert not found.malformed
        seen += found.requests
        rest = rest[found.used :]
        assert len(rest) < MAX_FRAME
    assert seen == requests
    assert rest == b""


@given(REQUEST)
def test_encoded_frame_equals_that_of_pymodbus(request: Request) -> None:
    framer = FramerSocket(DecodePDU(is_server=True))
    assert encode_frame(*request) == framer.encode(request.pdu, request.unit, request.transaction)


@given(st.binary(max_size=600))
def test_any_bytes_are_requests_incomplete_or_malformed(data: bytes) -> None:
    found = decode_frames(data, 100)
    assert b"".join(encode_frame(*request) for request in found.requests) == data[: found.used]
    rest = data[found.used :]
    if not found.malformed:
        assert len(rest) < MAX_FRAME
        assert rest[2:4] in (b"", b"\0", b"\0\0")


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
def test_invalid_length_is_malformed(length: int) -> None:
    good = encode_frame(1, 1, b"\x07")
    found = decode_frames(good + b"\0\0\0\0" + length.to_bytes(2, "big"), 2)
    assert found.requests == [Request(1, 1, b"\x07")]
    assert f"length {length}" in found.malformed


def test_limit_leaves_the_remainder_undecoded() -> None:
    frame, malformed = encode_frame(1, 1, b"\x07"), b"not Modbus"
    found = decode_frames(2 * frame + malformed, 2)
    assert (len(found.requests), found.used, found.malformed) == (2, 2 * len(frame), "")
    assert decode_frames(malformed, 2).malformed
