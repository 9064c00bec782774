"""Messages on the bus and in files (`v1/*.proto`), and the registry of topics (`topics`)."""

from hilrig_schemas.v1.control_pb2 import AddRig as AddRig
from hilrig_schemas.v1.control_pb2 import ControlReply as ControlReply
from hilrig_schemas.v1.control_pb2 import ControlRequest as ControlRequest
from hilrig_schemas.v1.control_pb2 import RemoveRig as RemoveRig
from hilrig_schemas.v1.control_pb2 import ResetRig as ResetRig
from hilrig_schemas.v1.control_pb2 import StartSession as StartSession
from hilrig_schemas.v1.control_pb2 import StopSession as StopSession
from hilrig_schemas.v1.event_pb2 import Event as Event
from hilrig_schemas.v1.health_pb2 import Health as Health
from hilrig_schemas.v1.health_pb2 import RigReport as RigReport
from hilrig_schemas.v1.impairment_pb2 import ImpairmentRequest as ImpairmentRequest
from hilrig_schemas.v1.impairment_pb2 import ImpairmentStatus as ImpairmentStatus
from hilrig_schemas.v1.joint_state_pb2 import JointState as JointState
from hilrig_schemas.v1.joint_state_pb2 import PartState as PartState
from hilrig_schemas.v1.lease_pb2 import LeaseRequest as LeaseRequest
from hilrig_schemas.v1.lease_pb2 import LeaseStatus as LeaseStatus
from hilrig_schemas.v1.log_batch_pb2 import LogBatch as LogBatch
from hilrig_schemas.v1.log_batch_pb2 import OpenSession as OpenSession
from hilrig_schemas.v1.modbus_traffic_pb2 import ModbusConnection as ModbusConnection
from hilrig_schemas.v1.modbus_traffic_pb2 import ModbusKind as ModbusKind
from hilrig_schemas.v1.modbus_traffic_pb2 import ModbusRequest as ModbusRequest
from hilrig_schemas.v1.modbus_traffic_pb2 import ModbusTraffic as ModbusTraffic
from hilrig_schemas.v1.rig_batch_pb2 import RigBatch as RigBatch
from hilrig_schemas.v1.rig_config_pb2 import RigConfig as RigConfig
from hilrig_schemas.v1.service_info_pb2 import ServiceInfo as ServiceInfo
from hilrig_schemas.v1.torque_command_pb2 import TorqueCommand as TorqueCommand
