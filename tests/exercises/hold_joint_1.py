"""Solution of "Hold joint 1": a proportional and derivative law for joint 1, as for the other joints."""

import argparse
import time

from pymodbus.client import ModbusTcpClient

GOAL = (30.0, 0.0, 0.0, 0.0)
KP, KD = (0.25, 0.25, 0.03, 0.004), (0.04, 0.03, 0.002, 0.0005)
PERIOD = 0.02


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    options = parser.parse_args()
    client = ModbusTcpClient(options.host, port=options.port)
    client.connect()
    begin = due = time.monotonic()
    before, speed = None, [0.0] * 4
    while time.monotonic() - begin < 6.0:
        words = client.read_holding_registers(4, count=4).registers
        q = [(word - 65536 if word > 32767 else word) / 100 for word in words]
        if before is not None:
            speed = [0.5 * s + 0.5 * (p - b) / PERIOD for s, p, b in zip(speed, q, before, strict=True)]
        before = q
        torques = [kp * (g - p) - kd * s for kp, g, p, kd, s in zip(KP, GOAL, q, KD, speed, strict=True)]
        torques[2] -= 4.905
        client.write_registers(0, [round(1000 * max(-32, min(32, torque))) & 0xFFFF for torque in torques])
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    client.close()


if __name__ == "__main__":
    main()
