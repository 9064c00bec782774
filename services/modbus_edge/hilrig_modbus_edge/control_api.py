"""Queries about one rig that the edge answers on the bus: its lease and its impairment."""

from pydantic import ValidationError

from hilrig_modbus_edge.device.device import Device
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.validation import format_validation_error
from hilrig_runtime.errors import InputError
from hilrig_runtime.process.control import decode_request
from hilrig_schemas import ImpairmentRequest, LeaseRequest


def handle_lease_query(device: Device, payload: bytes) -> bytes:
    """Handle a `LeaseRequest`; return a `LeaseStatus`."""
    request = decode_request(LeaseRequest, payload)
    released = device.release("revoked by an operator (hilrig lease --release)") if request.release else ""
    ended = device.end_claim("ended by an operator (hilrig lease --end-claim)") if request.end_claim else ""
    status = device.lease_status()
    status.released, status.claim_ended = released, ended
    return status.SerializeToString()


def handle_impairment_query(device: Device, payload: bytes) -> bytes:
    """Handle an `ImpairmentRequest`; return an `ImpairmentStatus`.

    Raises:
        InputError: the requested impairment is invalid.
    """
    request = decode_request(ImpairmentRequest, payload)
    if request.set_json:
        try:
            device.impairment.set(ImpairmentConfig.model_validate_json(request.set_json))
        except ValidationError as error:
            raise InputError("; ".join(format_validation_error(error))) from error
    elif request.restore_lab:
        device.impairment.set(None)
    return device.impairment.status().SerializeToString()
