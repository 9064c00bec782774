"""Checks a controller that is a Modbus server without writing to it: its address, and each block of its registers."""

import asyncio
from collections.abc import Awaitable, Callable

from hilrig_modbus_edge.client.exchange import ExchangeSettings
from hilrig_modbus_edge.client.faults import ControllerError, FaultKind
from hilrig_modbus_edge.client.tls_context import client_context
from hilrig_modbus_edge.client.transactions import ControllerConnection
from hilrig_runtime.timing.clock import SYSTEM_CLOCK


def probe_controller(settings: ExchangeSettings) -> list[str]:
    """Read every register that the edge would read or write; return the defects.

    Raises:
        InputError: a file of client.tls can't be used.
    """
    return asyncio.run(_probe(settings))


async def _probe(settings: ExchangeSettings) -> list[str]:
    context = None if settings.client.tls is None else client_context(settings.client.tls)
    registers, found = settings.registers, []
    connection = ControllerConnection(
        settings.host, settings.port, settings.unit, settings.client, context, SYSTEM_CLOCK
    )
    reads: list[Callable[[], Awaitable[object]]] = [
        lambda: connection.read_registers(registers.read_block, "torques"),
        lambda: connection.read_registers(registers.written_block, "positions"),
    ]
    if (magnet := registers.separate_magnet_block) is not None:
        reads.append(lambda: connection.read_bit(magnet, "the magnet"))
    try:
        await connection.connect()
        for read in reads:
            try:
                await read()
            except ControllerError as error:
                if error.kind is not FaultKind.EXCEPTION:
                    raise
                found.append(error.text)
    except ControllerError as error:
        found.append(error.text)
    finally:
        connection.close()
    return found
