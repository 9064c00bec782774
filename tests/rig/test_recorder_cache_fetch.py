"""A recorder that starts later, or again, fetches seconds of large cached batches without blocking the simulation.

Here the recorder is stopped during the fetch. The publisher must not wait for it.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_schemas.topics import Traffic
from support.labs import free_ports

pytestmark = [
    pytest.mark.rig,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads from /proc whether a process is stopped"),
]

KEY = "hil/lab/log/sim/1"
BATCH = bytes(130_000)
"""Size of the recording batch of one tick of 500 rigs."""
STEP_S = 0.02
CACHED_BEFORE = 400
CACHE_DEPTH = 1_000
"""Large enough on a busy machine: the depth of the cache is not tested here."""
STOPPED_S = 1.5
READER = f"""
import os, signal, sys, threading
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.bus.zenoh_bus import ZenohBus

numbers, done = [], threading.Event()

def on_message(key, payload):
    numbers.append(int.from_bytes(payload[:4], "big"))
    if len(numbers) == 5:
        os.kill(os.getpid(), signal.SIGSTOP)
    if numbers[-1] >= {CACHED_BEFORE + 50}:
        done.set()

with ZenohBus(BusConfig(first_port=int(sys.argv[1])), "recorder") as bus:
    bus.subscribe_recording("hil/lab/log/*/*", on_message, {CACHE_DEPTH})
    completed = done.wait(30)
print(completed, numbers == list(range(len(numbers))))
"""


def is_stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].startswith("T")


@pytest.mark.timeout(90)
def test_fetching_cached_messages_does_not_block_publisher() -> None:
    port = free_ports(3)
    puts_s: list[float] = []
    stopped_s: float | None = None
    with ZenohBus(BusConfig(first_port=port), "sim") as bus:
        put = bus.publisher(KEY, Traffic.RECORDING, CACHE_DEPTH).put
        for number in range(CACHED_BEFORE):
            put(number.to_bytes(4, "big") + BATCH)
        with subprocess.Popen([sys.executable, "-c", READER, str(port)], stdout=subprocess.PIPE, text=True) as reader:
            due_s = time.monotonic()
            while reader.poll() is None:
                begin_s = time.monotonic()
                put((CACHED_BEFORE + len(puts_s)).to_bytes(4, "big") + BATCH)
                puts_s.append(time.monotonic() - begin_s)
                if stopped_s is None and is_stopped(reader.pid):
                    stopped_s = begin_s
                if stopped_s is not None and begin_s > stopped_s + STOPPED_S:
                    os.kill(reader.pid, signal.SIGCONT)
                due_s = max(due_s + STEP_S, time.monotonic())
                time.sleep(max(0.0, due_s - time.monotonic()))
            assert reader.stdout is not None
            output = reader.stdout.read().split()
    assert stopped_s is not None
    assert output == ["True", "True"], "all messages, in order"
    assert max(puts_s) < STOPPED_S / 5, f"a put took {max(puts_s) * 1e3:.0f} ms"
