"""`hilrig certs`: a lab's certificates for Modbus/TCP Security."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_modbus_edge.certificates import Identity


def certs(
    folder: Annotated[Path, typer.Argument(help="Where they are written.")] = Path("certs"),
    host: Annotated[
        list[str] | None, typer.Option(help="Name or address by which clients reach the edge; may be given again.")
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=ROLE]",
            help="A controller and its role, operator (writes) or observer (reads); may be given again. "
            "Default: operator=operator and observer=observer.",
        ),
    ] = None,
    days: Annotated[int, typer.Option(min=1, help="How long they are valid.")] = 365,
    as_json: AsJson = False,
) -> None:
    """Make an authority, a certificate for the edge and one for each controller.

    An authority that is in the folder already is used again, and so is the edge's certificate where no --host is
    given: so controllers can be added. Keep the authority's key to yourself.
    """
    from datetime import UTC, datetime

    from hilrig_modbus_edge.certificates import issue_client, issue_server, load, make_authority
    from hilrig_runtime.errors import InputError, OperationError

    now = datetime.now(UTC)
    clients = dict(_name_and_role(text) for text in client or ["operator=operator", "observer=observer"])
    written: list[Path] = []

    def write(name: str, identity: "Identity") -> None:
        for path, data, mode in (
            (folder / f"{name}.pem", identity.certificate_pem, 0o644),
            (folder / f"{name}.key", identity.key_pem, 0o600),
        ):
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
                file.write(data)
            written.append(path)

    authority_files = (folder / "ca.pem", folder / "ca.key")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if all(path.exists() for path in authority_files):
            try:
                authority = load(*(path.read_bytes() for path in authority_files))
            except ValueError as error:
                raise InputError(f"{folder}: ca.pem and ca.key are no authority of ours: {error}") from error
        else:
            authority = make_authority(f"hilrig authority {now:%Y-%m-%d}", now, days)
            write("ca", authority)
        if host or not (folder / "edge.pem").exists():
            write("edge", issue_server(authority, host or ["127.0.0.1", "localhost"], now, days))
        for name, role in clients.items():
            write(name, issue_client(authority, name, role, now, days))
    except OSError as error:
        raise OperationError(f"{error.filename or folder}: can't be written: {error.strerror}") from error
    table = {key: str(folder / name) for key, name in (("certificate", "edge.pem"), ("key", "edge.key"))}
    table["authority"] = str(folder / "ca.pem")
    if as_json:
        print(json.dumps({"written": [str(path) for path in written], "edge.tls": table}))
        return
    for path in written:
        print(f"wrote {path}")
    print("\nin lab.toml:\n[edge.tls]")
    for key, value in table.items():
        print(f'{key} = "{value}"')


def _name_and_role(text: str) -> tuple[str, str]:
    from hilrig_runtime.errors import InputError
    from hilrig_schemas.topics import is_name

    name, _, role = text.partition("=")
    if not is_name(name) or name in ("ca", "edge"):
        raise InputError(f"--client {text}: expected NAME or NAME=ROLE, the name of letters, digits, - and _")
    if role not in ("", "operator", "observer"):
        raise InputError(f"--client {text}: a role is operator or observer, found {role!r}")
    return name, role
