"""`hilrig claim`: claims a rig with a student's code."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    import ssl

    from hilrig_runtime.config.lab import LabConfig

TIMEOUT_S: Final = 5.0
_REASONS: Final = {
    0x01: "this certificate may only read, so it can't claim a rig",
    0x02: "the rig takes no codes: its lab.toml has no classroom.claims",
    0x04: "the code is not valid for this rig: it is mistyped, for another rig, or its lab slot has ended",
    0x06: "not now: the rig is claimed by another student, your program writes from another machine, you have claimed "
    "another rig, or too many wrong codes came from this address (wait some seconds)",
}
"""By exception code."""


def claim(
    code: Annotated[
        str, typer.Argument(metavar="CODE", help="Your code, as ABCDE-FGHJK; case and hyphen do not matter.")
    ],
    rig: Annotated[
        str,
        typer.Argument(
            metavar="RIG", help="HOST or HOST:PORT of the rig, or its name in the lab file; default: its only rig."
        ),
    ] = "",
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Your certificate, PEM: connects with TLS, to its port.")
    ] = None,
    key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its private key, PEM.")] = None,
    authority: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Certificate of the authority of the lab (ca.pem).")
    ] = None,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Claim a rig until the end of the lab slot: from then on only this machine may write to it.

    Run it on the machine of your controller. The rig is bound to the address of this machine as the rig sees it, or to
    the name in the certificate. A program can claim the rig too: it writes the ten letters of the code into holding
    registers 401 to 405. Exit code 1: the code was refused; the reason is an event of the rig.
    """
    from hilrig_cli.json_output.lab import ClaimOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_runtime.addresses import format_address
    from hilrig_runtime.config.claim_codes import CODE_LETTERS, letters_of
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError

    letters = letters_of(code)
    if len(letters) != CODE_LETTERS or not letters.isascii():
        raise InputError(f"{code!r} is no code: expected {CODE_LETTERS} letters and digits, as ABCDE-FGHJK")
    files = (certificate, key, authority)
    if any(files) and not all(files):
        raise InputError("--certificate, --key and --authority belong together: give all three")
    host, port = _address(load_lab(config), rig, tls=all(files))
    exception = _write_code(host, port, letters, _context(*map(str, files)) if all(files) else None)
    where = format_address(host, port)
    reason = "" if not exception else _REASONS.get(exception, f"the rig answered with exception {exception:02X}")
    if as_json:
        print_json(ClaimOutput(rig=where, claimed=not exception, reason=reason))
    elif not exception:
        print(f"the rig at {where} is yours until the end of the lab slot")
    else:
        print(f"{where}: {reason}")
    if exception:
        raise typer.Exit(1)


def _address(lab: "LabConfig", rig: str, *, tls: bool) -> tuple[str, int]:
    """Return the address of a rig, given by its address or name."""
    from hilrig_runtime.addresses import WILDCARDS
    from hilrig_runtime.config.controller import parse_controller
    from hilrig_runtime.errors import InputError, list_names

    by_name = {one.name: one for one in lab.rigs}
    if not rig and len(by_name) > 1:
        raise InputError(f"which rig? Give its address, or one of {list_names([*by_name], 8)}: hilrig claim CODE RIG")
    ports = lab.tls_ports if tls else lab.ports
    found = by_name.get(rig or lab.rigs[0].name)
    if found is not None:
        if found.name not in ports:
            raise InputError("the lab file has no [edge.tls]: claim without --certificate, or give HOST:PORT")
        host = lab.host_of(found)
        return ("127.0.0.1" if host in WILDCARDS else host), ports[found.name]
    try:
        return parse_controller(rig, lab.edge.first_port if not tls else 802)
    except ValueError:
        raise InputError(f"{rig!r} is no address of a rig; expected HOST, HOST:PORT or [IPv6]:PORT") from None


def _context(certificate: str, key: str, authority: str) -> "ssl.SSLContext":
    import ssl

    from hilrig_runtime.errors import InputError

    try:
        context = ssl.create_default_context(cafile=authority)
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, OSError) as error:
        raise InputError(f"--certificate, --key, --authority: not PEM files that fit together: {error}") from error
    return context


def _write_code(host: str, port: int, letters: str, context: "ssl.SSLContext | None") -> int:
    """Write a code into the registers of a rig; return 0, or the code of the exception response.

    Raises:
        OperationError: no rig answers there.
    """
    import socket
    import struct

    from hilrig_runtime.addresses import format_address
    from hilrig_runtime.config.claim_codes import CLAIM_ADDRESS, CLAIM_REGISTERS
    from hilrig_runtime.errors import OperationError

    # Modbus TCP: header, function 16, address, quantity, number of bytes, values.
    pdu = struct.pack(">BHHB", 16, CLAIM_ADDRESS, CLAIM_REGISTERS, len(letters)) + letters.encode()
    where = format_address(host, port)
    try:
        with socket.create_connection((host, port), TIMEOUT_S) as plain:
            connection = plain if context is None else context.wrap_socket(plain, server_hostname=host)
            connection.sendall(struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu)
            response = b""
            while len(response) < 9:
                received = connection.recv(260)
                if not received:
                    raise OperationError(f"{where} closed the connection: is it a rig, and may this host connect?")
                response += received
            if context is not None:
                connection.close()
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise OperationError(f"{where} does not answer: {reason}; give the address of your rig") from error
    if response[7] == 16:
        return 0
    if response[7] != 16 | 0x80:
        raise OperationError(f"{where} answered with {response.hex(' ')}: that is no rig")
    return response[8]
