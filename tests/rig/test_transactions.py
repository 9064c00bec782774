"""Transactions with a controller, against a Modbus server on a socket."""

import asyncio
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

from hilrig_modbus_edge.client.transactions import ControllerConnection
from hilrig_runtime.config.controller import ClientConfig, RegisterBlock
from hilrig_runtime.timing.clock import SYSTEM_CLOCK

pytestmark = pytest.mark.rig

RESPONSE = bytes.fromhex("0005 01 03 02 0007")


async def serve(ended: asyncio.Event, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer each request with one register."""
    with suppress(ConnectionError):
        while request := await reader.read(12):
            writer.write(request[:4] + RESPONSE)
    writer.close()
    with suppress(ConnectionError):
        await writer.wait_closed()
    ended.set()


async def cancel_with_the_response(monkeypatch: pytest.MonkeyPatch) -> bool:
    """Cancel a task when the response to its request arrives; return whether it is canceled."""
    ended = asyncio.Event()
    server = await asyncio.start_server(partial(serve, ended), "127.0.0.1", 0)
    host, port = server.sockets[0].getsockname()
    connection = ControllerConnection(host, port, 1, ClientConfig(), None, SYSTEM_CLOCK)
    await connection.connect()
    transactions: Any = connection._transactions
    receive = transactions.callback_data
    task = asyncio.create_task(connection.read_registers(RegisterBlock("holding", 0, 1), "a register"))

    def receive_and_cancel(data: bytes, addr: Any = None) -> int:
        used: int = receive(data, addr)
        task.cancel()
        return used

    monkeypatch.setattr(transactions, "callback_data", receive_and_cancel)
    await asyncio.wait([task], timeout=10)
    connection.close()
    await ended.wait()
    server.close()
    return task.cancelled()


def test_cancellation_that_arrives_with_a_response_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    assert asyncio.run(cancel_with_the_response(monkeypatch))
