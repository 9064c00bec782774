"""What people ask of an edge over the bus: who holds a rig, what impairs it, rigs more or fewer.

A question comes on a thread of the bus and is answered on the loop, which alone touches devices.
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

ANSWER_TIMEOUT_S: Final = 1.0


class Rigs(Protocol):
    """What can be done about an edge's rigs; each says what it did, for people."""

    def add(self, rig: RigSettings) -> str:
        """Serve one more rig."""

    def remove(self, rig: str) -> str:
        """Serve a rig no more."""

    def reset(self, rig: str) -> str:
        """Put a rig back to its start pose."""


def serve_on_loop(bus: Bus, key: str, loop: asyncio.AbstractEventLoop, answer: Callable[[bytes], bytes]) -> Handle:
    """Answer questions asked on `key` with `answer`, on the loop."""

    def ask(payload: bytes) -> bytes:
        done: Future[bytes] = Future()
        loop.call_soon_threadsafe(_settle, done, partial(answer, payload))
        return done.result(ANSWER_TIMEOUT_S)

    return bus.declare_queryable(key, ask)


def answer_lease(device: Device, payload: bytes) -> bytes:
    """`LeaseRequest` to `LeaseStatus`."""
    request = LeaseRequest.FromString(payload)
    released = device.release("released by hand") if request.release else ""
    status = device.lease_status()
    status.released = released
    return status.SerializeToString()


def answer_impairment(device: Device, payload: bytes) -> bytes:
    """`ImpairmentRequest` to `ImpairmentStatus`.

    Raises:
        InputError: the impairment that is asked for is none.
    """
    request = ImpairmentRequest.FromString(payload)
    if request.set_json:
        try:
            device.impaired.set(ImpairmentConfig.model_validate_json(request.set_json))
        except ValidationError as error:
            raise InputError("; ".join(format_validation_error(error))) from error
    elif request.restore_lab:
        device.impaired.set(None)
    return device.impaired.status().SerializeToString()


def answer_control(rigs: Rigs, tell: Callable[[Event], None], payload: bytes) -> bytes:
    """Add, take away or reset a rig: `Event` to `Event`, which `tell` gets too.

    Raises:
        HilrigError: it can't be done.
    """
    request = Event.FromString(payload)
    if request.kind == Event.RIG_ADDED:
        text = rigs.add(read_rig(request.configuration_data.text))
    elif request.kind == Event.RIG_REMOVED:
        text = rigs.remove(request.rig)
    elif request.kind == Event.RESET:
        text = rigs.reset(request.rig)
    else:
        raise OperationError("a request that the edge does not know")
    answer = Event(kind=request.kind, severity=Event.INFO, rig=request.rig, text=text)
    if request.kind != Event.RESET:
        # Of a reset the simulation tells, when it is done.
        tell(answer)
    return answer.SerializeToString()


def _settle(done: Future[bytes], answer: Callable[[], bytes]) -> None:
    try:
        done.set_result(answer())
    except Exception as error:
        done.set_exception(error)
