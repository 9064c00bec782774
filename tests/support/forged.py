"""Forged recordings: seeded mutations of a recording, of its bytes, records, metadata, attachments and messages.

As a program, `python -m support.forged FOLDER COUNT SEED` evaluates forged recordings with the `hilrig` commands in one
process, whose memory is limited, and prints a JSON line a problem and a last one with the peak memory.
"""

import contextlib
import json
import resource
import signal
import struct
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import zstandard
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from mcap.opcode import Opcode

from hilrig_recorder.mcap_format.file_names import MAGIC
from hilrig_recorder.mcap_format.reader import buffer_reader
from hilrig_recorder.mcap_format.records import FOOTER_BYTES, RECORD_HEAD, DamagedError
from support.in_process import hilrig_in_process
from support.recordings import PARAMETERS, Script, make, write

SCRIPT = Script(seconds=0.6)
TIMEOUT_S = 20
MEMORY_BYTES = 6 << 30
"""Limit of the address space, most of which libraries reserve and never use."""

NUMBERS = ("-1", "0", str(1 << 63), str(1 << 64), "9" * 400, "1e400", "nan", "", " 7 ", "٣", "x", "-9" * 50, "1" * 5000)
INTEGERS = (0, 1, 0x7FFF, 0xFFFF, (1 << 31) - 1, (1 << 32) - 1, 1 << 43, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
TEXTS = (
    "",
    "\x1b[2J\x1b]0;x\x07",
    "a\nb\r\0c",
    "$x^{$",
    "<script>alert(1)</script>",
    "=1+1",
    "x" * 100_000,
    "[red]",
    "٣",
)
DOUBLES = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 0.0)


def forge(path: Path, random: Random) -> None:
    """Write one forged recording."""
    random.choice((_metadata, _attachment, _messages, _bytes, _bytes, _records, _records, _bomb))(path, random)


def _good(path: Path, **changes: Any) -> None:
    write(path, make(SCRIPT), script=SCRIPT, **changes)


@cache
def _good_bytes() -> bytes:
    with TemporaryDirectory() as folder:
        _good(Path(folder) / "run.mcap")
        return (Path(folder) / "run.mcap").read_bytes()


def _bytes(path: Path, random: Random) -> None:
    """Flip, zero, remove, repeat or truncate bytes anywhere."""
    data = bytearray(_good_bytes())
    for _ in range(random.choice((1, 1, 2, 8))):
        at, length = random.randrange(len(data) + 1), random.choice((1, 4, 64, 4096))
        kind = random.randrange(6)
        if kind <= 1:
            data[at : at + 1] = bytes(byte ^ 1 << random.randrange(8) for byte in data[at : at + 1])
        elif kind == 2:
            data[at : at + length] = bytes(len(data[at : at + length]))
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            data[at:at] = data[at : at + length]
        else:
            del data[at + 1 :]
    _store(path, data, random)


def _records(path: Path, random: Random) -> None:
    """Put an extreme number into the head or a field of a record."""
    data = bytearray(_good_bytes())
    reader = buffer_reader(bytes(data))
    summary = reader.summary()
    end = summary.end if random.random() < 0.7 else summary.start
    begin = summary.start if random.random() < 0.7 and end == summary.end else len(MAGIC)
    found = list(reader.heads(begin, end, 0))
    for _ in range(random.choice((1, 1, 3))):
        record = random.choice(found)
        number = random.choice(INTEGERS)
        at = record.offset + random.choice(
            (0, 1, *(9 + random.randrange(max(1, min(record.length, 60))) for _ in "123456"))
        )
        form = random.choice("BHIQ")
        size = struct.calcsize("<" + form)
        if at + size <= len(data):
            data[at : at + size] = (number & ((1 << 8 * size) - 1)).to_bytes(size, "little")
    _store(path, data, random)


def _metadata(path: Path, random: Random) -> None:
    """Replace values of the metadata records."""
    config = {"rig": "rig1", "step_ns": "20000000", "parameters_json": PARAMETERS.to_json()}
    session = {"session": "s", "rig": "rig1", "lab": "lab", "controller": "c", "schema_version": "hilrig.v1"}
    summary = dict.fromkeys(
        ("lost_transport", "lost_recorder", "overruns", "missed_steps", "clock_steps", "messages"), "0"
    )
    recovered = dict.fromkeys(("messages", "damaged_bytes", "torn_bytes", "orphans"), "3")
    records = {"config": config, "session": session, "summary": summary, "recovered": recovered}
    records = {name: values for name, values in records.items() if name == "config" or random.random() < 0.5}
    for _ in range(random.choice((1, 2, 3))):
        values = random.choice(list(records.values()))
        key = random.choice([*values, "part", "start_wall_ns", "incarnation"])
        values[key] = _parameters(random) if key == "parameters_json" else random.choice((*NUMBERS, *TEXTS))
        if random.random() < 0.2:
            values.pop(key)
    _good(
        path, metadata={f"hilrig.{name}": values for name, values in records.items()}, configured=random.random() < 0.5
    )


def _parameters(random: Random) -> str:
    """Parameters of a rig with a wrong value, or another JSON text."""
    if random.random() < 0.4:
        deep = 10_000
        return random.choice(
            (
                "[" * deep,
                "[" * deep + "]" * deep,
                '{"a":' * deep + "1" + "}" * deep,
                "9" * 400,
                "null",
                "[]",
                "{}",
                "1e400",
                '{"arm": {}}',
                "\x00",
                '"' + "x" * 1_000_000 + '"',
            )
        )
    values = json.loads(PARAMETERS.to_json())
    for _ in range(random.choice((1, 3))):
        place = values
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = random.choice(keys)
            if isinstance(place[key], dict | list) and random.random() < 0.8:
                place = place[key]
                continue
            place[key] = random.choice(
                (None, [], {}, "x", -1, 0, 1e308, float("nan"), float("inf"), 10**30, [[1]], True)
            )
            break
    return json.dumps(values)


def _attachment(path: Path, random: Random) -> None:
    """Replace `lab.toml` or the URDF."""
    deep = 200_000
    entities = '<!DOCTYPE r [<!ENTITY a "xxxxxxxxxx">' + "".join(
        f'<!ENTITY {"abcdefghij"[n + 1]} "{f"&{chr(97 + n)};" * 10}">' for n in range(9)
    )
    toml = (
        "x = " + "[" * deep,
        "x" * 1_000_000,
        "[task]\n" * 2,
        "\x00\xff",
        '[task]\ntitle = "$x"\nrig = 9e99',
        "[[task.poses]]\nname = 1",
        "[sim]\nstep_ms = " + "9" * 5000,
    )
    urdf = (
        entities + "]><r>&j;</r>",
        "<r>" * 100_000,
        "<r>" * 100_000 + "</r>" * 100_000,
        "<robot/>",
        "",
        "\x00",
        '<robot name="x"><link name="$a"/></robot>',
        '<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot/>',
    )
    if random.random() < 0.5:
        _good(path, lab_toml=random.choice(toml))
    else:
        _good(path, urdf_text=random.choice(urdf))


def _messages(path: Path, random: Random) -> None:
    """Replace fields and times of messages by extreme values."""
    made = make(SCRIPT)
    for _ in range(random.choice((1, 3, 30))):
        number = random.randrange(len(made))
        if random.random() < 0.2:
            made[number] = replace(
                made[number], publish_wall_ns=random.choice((0, 1, (1 << 63) - 1, (1 << 64) - 4_000_000))
            )
        else:
            _spoil(made[number].message, random)
    if random.random() < 0.2:
        random.shuffle(made)
    if random.random() < 0.2:
        del made[random.randrange(len(made)) :]
    write(path, made, script=SCRIPT)


def _spoil(message: Message, random: Random) -> None:
    fields = message.DESCRIPTOR.fields
    field = fields[random.randrange(len(fields))]
    values: dict[int, tuple[Any, ...]] = {
        FieldDescriptor.CPPTYPE_INT64: (-(1 << 63), (1 << 63) - 1, -1, 0),
        FieldDescriptor.CPPTYPE_UINT64: ((1 << 64) - 1, 1 << 63, 0),
        FieldDescriptor.CPPTYPE_INT32: (-(1 << 31), (1 << 31) - 1, 0),
        FieldDescriptor.CPPTYPE_UINT32: ((1 << 32) - 1, 0, 70_000),
        FieldDescriptor.CPPTYPE_DOUBLE: DOUBLES,
        FieldDescriptor.CPPTYPE_BOOL: (True, False),
        FieldDescriptor.CPPTYPE_STRING: TEXTS,
        FieldDescriptor.CPPTYPE_ENUM: (0, 1, 5, 77),
    }
    if field.message_type is not None:
        part = getattr(message, field.name)
        _spoil(part.add() if field.is_repeated else part, random)
        return
    value = random.choice(values[field.cpp_type])
    if not field.is_repeated:
        setattr(message, field.name, value)
        return
    items = getattr(message, field.name)
    kind = random.randrange(3)
    if kind == 0 and items:
        items[random.randrange(len(items))] = value
    elif kind == 1:
        items.append(value)
    else:
        del items[random.randrange(len(items) + 1) :]


def _bomb(path: Path, random: Random) -> None:
    """Add a chunk that expands to much more than the file, or says so."""
    data = bytearray(_good_bytes())
    raw_size = random.choice((1 << 30, 100 << 20, 1 << 43, (1 << 64) - 1, 0))
    packed = _compressed_gib() if random.random() < 0.5 else zstandard.compress(b"abc")
    head = struct.pack("<QQQII4sQ", 0, 1, raw_size, random.choice((0, 1)), 4, b"zstd", len(packed))
    chunk = RECORD_HEAD.pack(Opcode.CHUNK, len(head) + len(packed)) + head + packed
    if random.random() < 0.5:
        del data[buffer_reader(bytes(data)).summary().end :]
    at = len(data) if random.random() < 0.5 else len(MAGIC)
    data[at:at] = chunk
    path.write_bytes(data)


@cache
def _compressed_gib() -> bytes:
    """A GiB of zeros, compressed."""
    size = 1 << 30
    stream = zstandard.ZstdCompressor().compressobj(size=size)
    block = bytes(1 << 20)
    return b"".join(stream.compress(block) for _ in range(size >> 20)) + stream.flush()


def _store(path: Path, data: bytearray, random: Random) -> None:
    """Write the file, mostly with a valid checksum of the summary section or none, so that it is read further."""
    kind = random.random()
    if kind < 0.7 and data.endswith(MAGIC):
        with contextlib.suppress(DamagedError):
            data[-12:-8] = bytes(4)
            if kind < 0.35:
                summary = buffer_reader(bytes(data)).summary()
                data[-12:-8] = struct.pack("<I", zlib.crc32(data[summary.start : summary.end + FOOTER_BYTES - 4]))
    path.write_bytes(data)


# -- evaluation -----------------------------------------------------------------------------------------------------


def commands(path: Path, good: Path, out: Path) -> dict[str, list[str]]:
    """The commands that read a recording."""
    return {
        "latency": ["latency", str(path), "--json"],
        "list": ["latency", str(path), str(good)],
        "runs": ["runs", str(path.parent), "--rebuild"],
        "runs as JSON": ["runs", str(path.parent), "--rebuild", "--json"],
        "verify": ["verify", str(path)],
        "compare": ["compare", str(good), str(path), "--align", "start"],
        "recover": ["recover", str(path), "--out", str(out / "new.mcap")],
        "csv": ["export", str(path), "--csv", str(out)],
        "parquet": ["export", str(path), "--parquet", str(out)],
        "foxglove": ["export", str(path), "--foxglove", str(out / "fox.mcap")],
        "report": ["report", str(path), "--out", str(out / "report.html")],
        "replay": ["replay", str(path), "--save", str(out / "run.rrd")],
        "plot": ["latency", str(path), "--plot", str(out / "plot.png")],
    }


RARE = {"report": 0.06, "replay": 0.06, "plot": 0.06, "verify": 0.5, "foxglove": 0.3}
"""Share of the slow commands, relative to the others."""


def main(folder: Path, count: int, seed: int) -> None:
    """Evaluate forged recordings and print the problems."""

    def run(arguments: list[str]) -> tuple[object, str]:
        """Exit code, or the error that was raised, and standard error."""
        signal.alarm(TIMEOUT_S)
        try:
            done = hilrig_in_process(*arguments)
        except BaseException as error:
            return repr(error), ""
        finally:
            signal.alarm(0)
        return done.returncode, done.stderr

    def timed_out(*_: object) -> None:
        raise TimeoutError(f"no result within {TIMEOUT_S} s")

    signal.signal(signal.SIGALRM, timed_out)
    good, forged, out = folder / "good.mcap", folder / "forged" / "run.mcap", folder / "out"
    forged.parent.mkdir()
    out.mkdir()
    write(good, make(SCRIPT), script=SCRIPT)
    write(forged, make(SCRIPT), script=SCRIPT)
    for name, arguments in commands(forged, good, out).items():
        code, err = run(arguments)
        if code not in (0, 1):
            print(json.dumps({"case": "undamaged", "command": name, "code": code, "error": err}))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    slowest = (0.0, "")
    names = list(commands(forged, good, out))
    weights = [RARE.get(name, 1.0) for name in names]
    for number in range(seed, seed + count):
        random = Random(number)
        for path in out.iterdir():
            path.unlink()
        forge(forged, random)
        (name,) = random.choices(names, weights)
        began = time.perf_counter()
        code, err = run(commands(forged, good, out)[name])
        slowest = max(slowest, (time.perf_counter() - began, f"{number} {name}"))
        unclear = "can't be evaluated" in err or "out of memory" in err or "Traceback" in err
        if code not in (0, 1, 2) or unclear or (code == 2 and not err.startswith("hilrig: error: ")):
            print(json.dumps({"case": number, "command": name, "code": str(code), "error": err[-2000:]}), flush=True)
    after_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"before_kb": before_kb, "after_kb": after_kb, "slowest": slowest}))


Forge = Callable[[Path, Random], None]

if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
