"""Example joint controller that is a Modbus server, as a PLC is: the rig connects to it (the paper's arrangement).

    python server_controller.py --port 5502 --duration 16
    hilrig up --controller 127.0.0.1:5502

The rig writes the positions to holding registers 4-7 and reads the torques from 0-3, and the magnet from coil 0. With
echo = 9 in [rigs.registers] it also writes the step number to 8, and the program copies it to 9: the rig then detects a
stopped program. Exit code 0: the arm is at its goal at the end.
"""

import argparse
import asyncio
import sys
import time

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

TORQUES, POSITIONS, STEP, ECHO = 0, 4, 8, 9  # addresses of holding registers
PERIOD = 0.01  # period of the program, s: half a step of the simulation
POSES = [(30.0, -45.0, 50.0, 20.0), (-20.0, 60.0, 120.0, -30.0)]  # degrees, degrees, mm, degrees
MOVE_EVERY = 4.0  # s in each pose

# Gains: N·m per degree (N per mm) of error, and N·m per degree/s (N per mm/s) of speed.
KP = (0.25, 0.25, 0.03, 0.004)
KD = (0.04, 0.03, 0.002, 0.0005)
# Joint 3 carries the quill and counts positive downwards: an upward force compensates the weight.
GRAVITY = (0.0, 0.0, -0.5 * 9.81, 0.0)
MAX_ERROR = (30.0, 30.0, 40.0, 60.0)  # limits of the error, so that the arm does not accelerate too much


def signed(word: int) -> int:
    """Convert a register value to a signed number."""
    return word - 65536 if word > 32767 else word


async def main() -> int:
    """Serve the registers and run the program; return 0 if the arm is at its goal at the end."""
    parser = argparse.ArgumentParser(description="Hold the arm and move it between two poses, as a Modbus server.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5502)
    parser.add_argument("--duration", type=float, default=16.0, help="seconds from the first positions on")
    options = parser.parse_args()

    coils = [SimData(0, count=8, values=False, datatype=DataType.BITS)]
    registers = [SimData(0, count=16, values=0, datatype=DataType.REGISTERS)]
    connected = asyncio.Event()
    server = ModbusTcpServer(
        SimDevice(1, simdata=(coils, coils, registers, registers)),
        address=(options.host, options.port),
        trace_connect=lambda _: connected.set(),
    )
    await server.serve_forever(background=True)
    await connected.wait()

    begin, before = time.monotonic(), None
    speed, error = [0.0] * 4, [0.0] * 4
    while time.monotonic() - begin < options.duration:
        await asyncio.sleep(PERIOD)
        *words, step = await server.async_getValues(1, 3, POSITIONS, STEP - POSITIONS + 1)
        position = [signed(word) / 100 for word in words]
        if before is not None:
            # The registers have a resolution of 0.01, so the difference quotient is filtered.
            speed = [0.9 * s + 0.1 * (p - b) / PERIOD for s, p, b in zip(speed, position, before, strict=True)]
        before = position

        goal = POSES[int((time.monotonic() - begin) / MOVE_EVERY) % len(POSES)]
        error = [g - p for g, p in zip(goal, position, strict=True)]
        limited = [max(-m, min(m, e)) for m, e in zip(MAX_ERROR, error, strict=True)]
        torque = [kp * e - kd * s + w for kp, e, kd, s, w in zip(KP, limited, KD, speed, GRAVITY, strict=True)]
        words = [max(-32767, min(32767, round(1000 * t))) & 0xFFFF for t in torque]
        await server.async_setValues(1, 16, TORQUES, words)
        await server.async_setValues(1, 16, ECHO, [step])
    await server.async_setValues(1, 16, TORQUES, [0, 0, 0, 0])
    print("error at the end: " + ", ".join(f"{e:+.2f}" for e in error))
    return 0 if max(abs(e) for e in error) < 2.0 else 1


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
