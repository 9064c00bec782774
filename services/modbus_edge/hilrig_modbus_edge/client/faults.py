"""Failed requests to a controller, described in the terms of its users."""

import errno
import socket
import ssl
from enum import StrEnum
from typing import Final

from hilrig_runtime.config.controller import RegisterBlock

_EXCEPTIONS: Final = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
"""Names of the exception codes in the specification."""


class FaultKind(StrEnum):
    """Kinds of failures; each is reported at its own rate."""

    REFUSED = "connection refused"
    UNREACHABLE = "unreachable"
    TLS = "TLS handshake failed"
    CLOSED = "connection closed"
    TIMEOUT = "no response"
    INCOMPLETE = "incomplete response"
    MALFORMED = "malformed response"
    WRONG_TRANSACTION = "wrong transaction identifier"
    LATE = "late response"
    EXCEPTION = "exception response"
    NOT_RUNNING = "program not running"
    WRONG_ECHO = "no step number in the echo register"
    REVOKED = "lease revoked"
    NOT_OWNED = "rig not claimed"


class ControllerError(Exception):
    """A request to a controller failed."""

    def __init__(self, kind: FaultKind, text: str, *, closes: bool = True) -> None:
        super().__init__(text)
        self.kind = kind
        self.text = text
        """Human-readable: what failed, and the fix if there is one."""
        self.closes = closes
        """Whether the connection is unusable."""


def connection_fault(error: BaseException, host: str, port: int) -> ControllerError:
    """Return the fault for an error while a connection was established."""
    if isinstance(error, ConnectionRefusedError) or f"[Errno {errno.ECONNREFUSED}]" in str(error):
        # The error of a host with several addresses has only the texts of their errors.
        text = f"connection refused: nothing listens on port {port}; start the controller's server, or correct its port"
        return ControllerError(FaultKind.REFUSED, text)
    if isinstance(error, ssl.SSLError):
        reason = error.verify_message if isinstance(error, ssl.SSLCertVerificationError) else error.reason or str(error)
        return ControllerError(FaultKind.TLS, f"TLS handshake failed: {reason}; check client.tls in lab.toml")
    if isinstance(error, socket.gaierror):
        text = f"the name {host!r} has no address; correct controller in lab.toml, or the name server"
        return ControllerError(FaultKind.UNREACHABLE, text)
    if isinstance(error, ConnectionResetError):
        return ControllerError(FaultKind.CLOSED, closed_text(error))
    if isinstance(error, TimeoutError) and not error.errno:
        text = "no connection: the host does not answer; check address, cable and firewall"
        return ControllerError(FaultKind.UNREACHABLE, text)
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return ControllerError(FaultKind.UNREACHABLE, f"no connection: {reason}; check address, cable and firewall")


def closed_text(error: BaseException | None, responses: int = 0) -> str:
    """Return a description of a lost connection.

    Args:
        error: None: the controller closed it in order.
        responses: number of its responses.
    """
    if error is None and responses == 1:
        return "the controller closed the connection after one response: configure it to keep connections open"
    if error is None:
        return "the controller closed the connection; it may accept one client only: disconnect other programs"
    if isinstance(error, ConnectionResetError | BrokenPipeError):
        return "the controller reset the connection: it was restarted, or its server stopped"
    if isinstance(error, OSError) and error.errno in (errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH):
        return f"the connection was lost: {error.strerror}; check cable and power"
    return f"the connection was lost: {error}"


def exception_fault(code: int, function: int, action: str, block: RegisterBlock) -> ControllerError:
    """Return the fault for an exception response to a request that reads or writes a block; `action` names that."""
    name = _EXCEPTIONS.get(code, "unknown code")
    fix = {
        1: f"the controller does not support function {function} for them",
        2: "they do not all exist in the controller: correct [rigs.registers] in lab.toml, or declare them there",
        10: "correct unit in lab.toml",
        11: "correct unit in lab.toml",
    }.get(code, "see the controller's diagnosis")
    text = f"exception {code:02X} ({name}) to function {function}, {action} {block}: {fix}"
    return ControllerError(FaultKind.EXCEPTION, text, closes=False)
