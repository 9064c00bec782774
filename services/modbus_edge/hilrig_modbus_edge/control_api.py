"""Queries that the edge answers on the bus: lease, impairment, and adding, removing or resetting rigs.

A query arrives on a thread of the bus and is handled on the event loop, the only thread that accesses devices.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Final, Protocol

from pydantic import ValidationError

from hilrig_modbus_edge.device.device import Device
from hilrig_runtime.bus.api import Bus, Handle
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.lab import RigSettings, read_rig
from hilrig_runtime.config.validation import format_validation_error
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas import Event, ImpairmentRequest, LeaseRequest

REPLY_TIMEOUT_S: Final = 1.0
"""Timeout for the event loop to handle a query, s."""


class RigManager(Protocol):
    """Operations on the rigs of an edge; each returns a human-readable result."""

    def add(self, rig: RigSettings) -> str:
        """Start to serve a rig."""

    def remove(self, rig: str) -> str:
        """Stop serving a rig."""

    def reset(self, rig: str) -> str:
        """Move the arm of a rig to its start pose."""


def serve_on_loop(bus: Bus, key: str, loop: asyncio.AbstractEventLoop, handler: Callable[[bytes], bytes]) -> Handle:
    """Answer the queries on `key` with `handler`, called on the event loop."""

    def ask(payload: bytes) -> bytes:
        done: Future[bytes] = Future()
        loop.call_soon_threadsafe(_set_result, done, partial(handler, payload))
        return done.result(REPLY_TIMEOUT_S)

    return bus.declare_queryable(key, ask)


def handle_lease_query(device: Device, payload: bytes) -> bytes:
    """Handle a `LeaseRequest`; return a `LeaseStatus`."""
    request = LeaseRequest.FromString(payload)
    released = device.release("revoked by an operator (hilrig lease --release)") if request.release else ""
    status = device.lease_status()
    status.released = released
    return status.SerializeToString()


def handle_impairment_query(device: Device, payload: bytes) -> bytes:
    """Handle an `ImpairmentRequest`; return an `ImpairmentStatus`.

    Raises:
        InputError: the requested impairment is invalid.
    """
    request = ImpairmentRequest.FromString(payload)
    if request.set_json:
        try:
            device.impairment.set(ImpairmentConfig.model_validate_json(request.set_json))
        except ValidationError as error:
            raise InputError("; ".join(format_validation_error(error))) from error
    elif request.restore_lab:
        device.impairment.set(None)
    return device.impairment.status().SerializeToString()


def handle_control_query(rigs: RigManager, emit: Callable[[Event], None], payload: bytes) -> bytes:
    """Add, remove or reset a rig as an `Event` requests; return the result as an `Event`, which is also emitted.

    Raises:
        HilrigError: the request is invalid or cannot be executed.
    """
    request = Event.FromString(payload)
    if request.kind == Event.RIG_ADDED:
        text = rigs.add(read_rig(request.configuration_data.text))
    elif request.kind == Event.RIG_REMOVED:
        text = rigs.remove(request.rig)
    elif request.kind == Event.RESET:
        text = rigs.reset(request.rig)
    else:
        raise OperationError(
            f"unknown control request of kind {request.kind}: client and edge must have the same hilrig version"
        )
    reply = Event(kind=request.kind, severity=Event.INFO, rig=request.rig, text=text)
    if request.kind != Event.RESET:
        # The event of a reset is emitted by the simulation, when it has executed it.
        emit(reply)
    return reply.SerializeToString()


def _set_result(done: Future[bytes], call: Callable[[], bytes]) -> None:
    try:
        done.set_result(call())
    except Exception as error:
        done.set_exception(error)
