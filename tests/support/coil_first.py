"""Controller in the order of OpenPLC: it writes a coil, reads the positions, and writes the torques.

Usage: coil_first.py HOST PORT SECONDS.
"""

import sys
import time

from pymodbus.client import ModbusTcpClient


def main() -> None:
    host, port, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    client = ModbusTcpClient(host, port=port)
    assert client.connect()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert not client.write_coils(0, [False]).isError()
        word = client.read_holding_registers(4, count=4).registers[0]
        position = (word - 65536 if word > 32767 else word) / 100
        torque = int(1000 * max(-5.0, min(5.0, 0.02 * (30 - position)))) & 0xFFFF
        assert not client.write_registers(0, [torque, 0, -4905 & 0xFFFF, 0]).isError()
        time.sleep(0.015)  # the period of a controller
    client.close()


if __name__ == "__main__":
    main()
