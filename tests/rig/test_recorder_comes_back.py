"""A recorder that comes to a class of rigs, or back to it, fetches seconds of large batches: the simulation goes on.

Here it is held up in the middle of that, for the publisher must not wait for it then either.
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
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="sees in /proc whether a process is held up"),
]

KEY = "hil/lab/log/sim/1"
BATCH = bytes(130_000)
"""What a tick of 500 rigs is on the record."""
STEP_S = 0.02
BEFORE = 400
CACHE_DEPTH = 1_000
"""Ample, also where the machine is busy: this is not about how far a cache reaches."""
HELD_UP_S = 1.5
READER = f"""
import os, signal, sys, threading
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.bus.zenoh_bus import ZenohBus

numbers, lost, done = [], [], threading.Event()

def on_message(key, payload):
    numbers.append(int.from_bytes(payload[:4], "big"))
    if len(numbers) == 5:
        os.kill(os.getpid(), signal.SIGSTOP)
    if numbers[-1] >= {BEFORE + 50}:
        done.set()

with ZenohBus(BusConfig(first_port=int(sys.argv[1])), "recorder") as bus:
    bus.subscribe_recording("hil/lab/log/*/*", on_message, lost.append, {CACHE_DEPTH})
    in_time = done.wait(30)
print(in_time, numbers == list(range(len(numbers))), sum(lost))
"""


def is_held_up(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].startswith("T")


@pytest.mark.timeout(90)
def test_what_is_fetched_from_a_cache_does_not_hold_its_publisher_up() -> None:
    port = free_ports(3)
    puts_s: list[float] = []
    held_up_s: float | None = None
    with ZenohBus(BusConfig(first_port=port), "sim") as bus:
        put = bus.publisher(KEY, Traffic.RECORDING, CACHE_DEPTH).put
        for number in range(BEFORE):
            put(number.to_bytes(4, "big") + BATCH)
        with subprocess.Popen([sys.executable, "-c", READER, str(port)], stdout=subprocess.PIPE, text=True) as reader:
            due_s = time.monotonic()
            while reader.poll() is None:
                begin_s = time.monotonic()
                put((BEFORE + len(puts_s)).to_bytes(4, "big") + BATCH)
                puts_s.append(time.monotonic() - begin_s)
                if held_up_s is None and is_held_up(reader.pid):
                    held_up_s = begin_s
                if held_up_s is not None and begin_s > held_up_s + HELD_UP_S:
                    os.kill(reader.pid, signal.SIGCONT)
                due_s = max(due_s + STEP_S, time.monotonic())
                time.sleep(max(0.0, due_s - time.monotonic()))
            assert reader.stdout is not None
            said = reader.stdout.read().split()
    assert held_up_s is not None
    assert said == ["True", "True", "0"], "all of it, in order"
    assert max(puts_s) < HELD_UP_S / 5, f"a put took {max(puts_s) * 1e3:.0f} ms"
