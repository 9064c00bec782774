"""Decodes the Modbus requests of a recording to rows, in the current message format and in the previous one."""

import struct

from google.protobuf.message import DecodeError

from hilrig_replay.io.columns import DecodeFunction, RowBuffer, StringTable
from hilrig_schemas import ModbusKind, ModbusRequest, ModbusTraffic


def traffic_decoder(requests: RowBuffer, connections: RowBuffer, names: StringTable) -> DecodeFunction:
    """Return a function that adds `ModbusTraffic` messages to two buffers.

    Args:
        requests: rows as `columns.TRAFFIC_DTYPE`.
        connections: TCP figures, rows as `columns.CONNECTION_DTYPE`.
        names: texts of the codes in the rows.
    """
    message = ModbusTraffic()
    parse, pack = message.ParseFromString, requests.pack

    def fields(kind: ModbusKind | ModbusRequest) -> tuple[int, ...]:
        controller = names.code(kind.controller)
        return kind.address & 0xFFFF, kind.count & 0xFFFF, controller, kind.function & 0xFF, kind.exception & 0xFF

    def decode(payload: bytes, sequence: int, log_ns: int) -> None:  # noqa: ARG001
        parse(payload)
        wall_from_monotonic = message.wall_ns - message.closed_ns
        kinds = [fields(kind) for kind in message.kinds]
        columns = zip(message.kind_indexes, message.arrived_ns, message.answered_after_ns, strict=True)
        try:
            requests.extend(
                [
                    pack(wall_from_monotonic + arrived_ns, arrived_ns, arrived_ns + after_ns, *kinds[index])
                    for index, arrived_ns, after_ns in columns
                ]
            )
        except (ValueError, IndexError, struct.error) as error:
            raise DecodeError(f"inconsistent request columns: {error}") from error
        for request in message.requests:
            arrived_ns = request.arrived_ns
            requests.add(pack(wall_from_monotonic + arrived_ns, arrived_ns, request.answered_ns, *fields(request)))
        for tcp in message.connections:
            row = message.wall_ns, tcp.min_rtt_us, tcp.retransmissions, names.code(tcp.controller)
            connections.add(connections.pack(*row))

    return decode
