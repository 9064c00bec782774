"""The demo's controller on a slow network: with a loop latency of 60 ms it places every part.

In virtual time: `tests/unit/test_pick_and_place.py`.
"""

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hilrig_cli.local.demo import check_placement
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.labs import RunningLab, write_lab
from support.waiting import eventually

pytestmark = [
    pytest.mark.rig,
    pytest.mark.real_time,
    pytest.mark.long("takes a minute"),
]

ROOT = Path(__file__).parents[2]
RUNS = 3


@contextmanager
def slow_network(port: int, delay_s: float) -> Iterator[int]:
    """TCP proxy to a port that delays every byte by `delay_s` in each direction; yields the proxy's port."""
    loop = asyncio.new_event_loop()

    async def forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(4096):
            loop.call_later(delay_s, writer.write, data)
        loop.call_later(delay_s, writer.close)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        await asyncio.gather(forward(reader, far_writer), forward(far_reader, writer), return_exceptions=True)

    server = loop.run_until_complete(asyncio.start_server(serve, "127.0.0.1", 0))
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5)


@pytest.mark.parametrize("attempt", range(RUNS))
def test_every_part_is_placed_with_a_loop_of_60_ms(attempt: int, tmp_path: Path) -> None:
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 100")) as lab:
        with slow_network(lab.port, 0.020) as port:
            command = [sys.executable, str(ROOT / "examples/pick_and_place.py"), "--port", str(port), "--json"]
            command += ["--once", "--duration", "45"]
            done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=90)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["placed"] == 4
        eventually(lambda: lab.recordings)
        run = open_run(lab.recordings[0])
    report = measure(run)
    assert report.loop_ms is not None
    assert report.loop_ms.p50 == pytest.approx(60, abs=12)
    result = check_placement(run)
    assert result.placed == len(result.parts) == 4
    assert result.largest_error_mm is not None
    assert result.largest_error_mm < 2.0
