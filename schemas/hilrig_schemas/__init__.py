"""Messages on the bus and in files (`v1/*.proto`), and the registry of topics (`topics`)."""

from hilrig_schemas.v1.control_pb2 import (
    AddRig,
    ControlReply,
    ControlRequest,
    RemoveRig,
    ResetRig,
    StartSession,
    StopSession,
)
from hilrig_schemas.v1.event_pb2 import Event
from hilrig_schemas.v1.health_pb2 import Health, RigReport
from hilrig_schemas.v1.impairment_pb2 import ImpairmentRequest, ImpairmentStatus
from hilrig_schemas.v1.joint_state_pb2 import JointState, PartState
from hilrig_schemas.v1.lease_pb2 import LeaseRequest, LeaseStatus
from hilrig_schemas.v1.log_batch_pb2 import LogBatch, OpenSession
from hilrig_schemas.v1.modbus_traffic_pb2 import ModbusConnection, ModbusKind, ModbusRequest, ModbusTraffic
from hilrig_schemas.v1.rig_batch_pb2 import RigBatch
from hilrig_schemas.v1.rig_config_pb2 import RigConfig
from hilrig_schemas.v1.service_info_pb2 import ServiceInfo
from hilrig_schemas.v1.torque_command_pb2 import TorqueCommand

__all__ = [
    "AddRig",
    "ControlReply",
    "ControlRequest",
    "Event",
    "Health",
    "ImpairmentRequest",
    "ImpairmentStatus",
    "JointState",
    "LeaseRequest",
    "LeaseStatus",
    "LogBatch",
    "ModbusConnection",
    "ModbusKind",
    "ModbusRequest",
    "ModbusTraffic",
    "OpenSession",
    "PartState",
    "RemoveRig",
    "ResetRig",
    "RigBatch",
    "RigConfig",
    "RigReport",
    "ServiceInfo",
    "StartSession",
    "StopSession",
    "TorqueCommand",
]
