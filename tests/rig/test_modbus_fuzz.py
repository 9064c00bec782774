"""Fuzz test of the edge: every request gets its response, and other clients are not affected.

`HILRIG_FUZZ_FRAMES` sets the number of frames; the seed is printed, and `HILRIG_FUZZ_SEED` repeats it.
"""

import json
import os
import random
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_modbus_edge.protocol.functions import FunctionCode
from support.clients import build_c_client
from support.edge_rig import HEADER
from support.labs import RunningLab, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

FRAMES = int(os.environ.get("HILRIG_FUZZ_FRAMES", "50000"))
SEED = int(os.environ.get("HILRIG_FUZZ_SEED", random.SystemRandom().randrange(2**32)))

READER = """
import json, select, socket, sys, time
client = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
times = []
print("ready", flush=True)
while True:
    if select.select([0], [], [], 0.002)[0]:
        break
    asked = time.perf_counter()
    client.sendall(bytes.fromhex("000100000006010300000008"))
    answer = client.recv(300)
    if len(answer) != 25:
        sys.exit(f"wrong answer: {answer.hex()}")
    times.append(time.perf_counter() - asked)
print(json.dumps({"reads": len(times), "p99_ms": sorted(times)[int(0.99 * len(times))] * 1e3}))
"""


def random_pdu(chance: random.Random) -> bytes:
    """Return a request that is valid, nearly valid, or random."""
    function = chance.choice((*map(int, FunctionCode), chance.randrange(256)))
    address = chance.choice((0, 1, 3, 4, 7, 8, 35, 36, 99, 100, 101, 102, 0xFFFF, chance.randrange(65536)))
    count = chance.choice((0, 1, 2, 4, 8, 36, 121, 123, 125, 126, 2000, 0xFFFF, chance.randrange(65536)))
    if function in (1, 2, 3, 4, 5, 6):
        return struct.pack(">BHH", function, address, count)
    if function in (15, 16):
        data = chance.randbytes(chance.choice((2, 8, 2 * min(count, 123), chance.randrange(247))))
        return struct.pack(">BHHB", function, address, count, len(data) & 0xFF) + data
    if function == 23:
        data = chance.randbytes(chance.choice((2, 8, chance.randrange(243))))
        return struct.pack(">BHHHHB", 23, address, count, chance.choice((0, 4)), len(data) // 2, len(data)) + data
    if function == 43:
        return bytes((43, chance.choice((13, 14)), chance.randrange(6), chance.randrange(256)))
    return bytes((function,)) + chance.randbytes(chance.randrange(253))


def mutated(chance: random.Random, frame: bytes) -> bytes:
    """Return the frame with some bytes changed, removed, or inserted."""
    data = bytearray(frame)
    for _ in range(chance.randrange(1, 4)):
        where = chance.randrange(len(data))
        match chance.randrange(4):
            case 0:
                data[where] ^= 1 << chance.randrange(8)
            case 1:
                data[where] = chance.randrange(256)
            case 2 if len(data) > 1:
                del data[where]
            case _:
                data[where:where] = chance.randbytes(chance.randrange(1, 5))
    return bytes(data)


def random_stream(chance: random.Random, frames: int) -> bytes:
    """Return the data of one connection; most headers are valid, because nothing is read after an invalid one."""
    parts = []
    for _ in range(frames):
        pdu = random_pdu(chance)[:253]
        unit = chance.choice((0, 1, 1, 1, 255, chance.randrange(256)))
        frame = HEADER.pack(chance.randrange(65536), 0, len(pdu) + 1, unit) + pdu
        kind = chance.random()
        if kind < 0.35 and len(frame) > 9:
            # Mutated after the header, with a valid length.
            body = mutated(chance, frame[7:])[:253]
            frame = HEADER.pack(chance.randrange(65536), 0, len(body) + 1, unit) + body if body else frame
        elif kind < 0.352:
            frame = mutated(chance, frame)
        elif kind < 0.353:
            frame = chance.randbytes(chance.randrange(1, 300))
        parts.append(frame)
    stream = b"".join(parts)
    return stream[: chance.randrange(len(stream))] if chance.random() < 0.1 else stream


def requests_in(stream: bytes) -> list[tuple[int, int, int]]:
    """Return transaction, unit and function of each request, up to the first malformed one."""
    found = []
    while len(stream) >= 8:
        transaction, protocol, length, unit = HEADER.unpack(stream[:7])
        if protocol != 0 or not 2 <= length <= 254 or len(stream) < 6 + length:
            break
        found.append((transaction, unit, stream[7]))
        stream = stream[6 + length :]
    return found


def talk(port: int, stream: bytes) -> bytes:
    """Send the data, and return everything received until the edge closes the connection."""
    answers = b""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        try:
            client.sendall(stream)
            client.shutdown(socket.SHUT_WR)
            while part := client.recv(65536):
                answers += part
        except OSError:
            # The edge closed the connection after a malformed request, with further data in flight.
            pass
    return answers


def resident_mib(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.timeout(600)
def test_random_frames_do_not_affect_other_clients(tmp_path: Path) -> None:
    print(f"HILRIG_FUZZ_SEED={SEED}")
    chance = random.Random(SEED)
    controller = build_c_client()
    # Generated in advance, so that the generation does not load the machine during the measurement.
    streams: list[tuple[int, bytes]] = []
    while sum(frames for frames, _ in streams) < FRAMES:
        frames = chance.randrange(1, 400)
        streams.append((frames, random_stream(chance, frames)))
    with RunningLab(write_lab(tmp_path, rigs=2)) as lab:
        fuzzed, other = (lab.lab.ports[name] for name in ("rig1", "rig2"))
        edge = lab.service_pid("edge")
        reader = subprocess.Popen(
            [sys.executable, "-c", READER, str(fuzzed)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert reader.stdout is not None
        assert reader.stdout.readline() == "ready\n"
        looping = subprocess.Popen(
            [controller, "127.0.0.1", str(other), "600", "20"], stdout=subprocess.PIPE, stdin=subprocess.PIPE
        )
        sent = 0
        before_mib = None
        try:
            for frames, stream in streams:
                answers = talk(fuzzed, stream)
                requests, responses = requests_in(stream), requests_in(answers)
                assert len(responses) <= len(requests)
                for (transaction, unit, function), (t, u, f) in zip(requests, responses, strict=False):
                    assert (t, u, f & 0x7F) == (transaction, unit, function & 0x7F)
                if not has_malformed_data(stream, requests):
                    assert len(responses) == len(requests), f"{len(requests)} requests, {len(responses)} answers"
                sent += frames
                if before_mib is None and sent > FRAMES / 4:
                    before_mib = resident_mib(edge)
            assert reader.poll() is None
            out, _ = reader.communicate("\n", timeout=10)
            healthy = json.loads(out)
            assert looping.poll() is None, "the controller of the other rig was disturbed"
        finally:
            for process in (reader, looping):
                process.kill()
                process.communicate()
        assert lab.service_pid("edge") == edge
        assert before_mib is not None
        grown_mib = resident_mib(edge) - before_mib
        print(f"{sent} frames, {len(streams)} connections, other client {healthy}, memory {grown_mib:+.1f} MiB")
        assert healthy["p99_ms"] < 1000
        assert grown_mib < 16
        assert "Traceback" not in lab.output()
        assert "ERROR" not in lab.output()
        eventually(lambda: lab.stop() == 0)


def has_malformed_data(stream: bytes, requests: list[tuple[int, int, int]]) -> bool:
    """Return whether malformed data follows the requests: it may reset the connection and discard responses."""
    used = 0
    for _ in requests:
        used += 6 + struct.unpack_from(">H", stream, used + 4)[0]
    return used < len(stream)
