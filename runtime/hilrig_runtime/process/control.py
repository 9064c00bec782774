"""Control requests: decoding, the version rule of both sides, and the choice of a service's handler."""

from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any, TypeVar

from google.protobuf.message import DecodeError, Message

from hilrig_runtime.errors import OperationError
from hilrig_schemas import ControlReply, ControlRequest
from hilrig_schemas.bounds import check_bounds

MessageT = TypeVar("MessageT", bound=Message)

Handlers = Mapping[str, Callable[[Any], ControlReply]]
"""Handlers of control requests, by the field of the request, as `add_rig`; they get that field."""


def handle_control_request(handlers: Handlers, payload: bytes) -> bytes:
    """Execute a `ControlRequest` with the handler of its kind; return a `ControlReply`.

    Raises:
        HilrigError: the request is of another version, unknown or invalid, or cannot be executed.
    """
    request, own = decode_request(ControlRequest, payload), version("hilrig")
    check_versions(own, request.software_version)
    kind = request.WhichOneof("request")
    if kind is None:
        raise _wrong_version(own, request.software_version)
    if kind not in handlers:
        raise OperationError(f"this service does not execute {kind}; it executes {', '.join(handlers)}")
    reply = handlers[kind](getattr(request, kind))
    reply.software_version = own
    return reply.SerializeToString()


def decode_request(message: type[MessageT], payload: bytes) -> MessageT:
    """Decode the request of a query.

    Raises:
        OperationError: the payload is not a message of this type, or a value is out of its bounds.
    """
    name = message.DESCRIPTOR.name
    try:
        request = message.FromString(payload)
    except DecodeError as error:
        raise OperationError(f"not a valid {name}: {len(payload)} bytes can't be decoded") from error
    try:
        check_bounds(request)
    except DecodeError as error:
        raise OperationError(f"not a valid {name}: {error}") from error
    return request


def check_versions(services: str, command: str) -> None:
    """Check that two versions of hilrig are of the same release series, and so exchange control requests.

    Raises:
        OperationError: they differ; contains both. An empty version of the command is 0.1's, which sends none.
    """
    if release_series(services) != release_series(command):
        raise _wrong_version(services, command)


def release_series(software_version: str) -> tuple[str, ...]:
    """Return the numbers of a version that are equal in compatible versions: the first; before 1.0 the second too."""
    numbers = software_version.split(".")
    return tuple(numbers[:2] if numbers[0] == "0" else numbers[:1])


def _wrong_version(services: str, command: str) -> OperationError:
    return OperationError(
        f"wrong version: services {services}, command {command or '0.1'}; install the same version on both"
    )
