"""`hilrig console`: web console of the lab."""

from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.commands.services import LogFormat
from hilrig_cli.options import Config, announcer


def console(
    config: Config = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; :8050 listens on all addresses.")
    ] = "127.0.0.1:8050",
    password_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File whose first line is the password. Default: no password on loopback, otherwise a generated one, "
            "which is printed.",
        ),
    ] = None,
    certificate: Annotated[Path | None, typer.Option(metavar="PEM", help="Serve HTTPS with this certificate.")] = None,
    key: Annotated[Path | None, typer.Option(metavar="PEM", help="Private key of the certificate.")] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="Additional host name that browsers use for this host; may be repeated."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Check that the console at --listen responds; for container health checks.")
    ] = False,
    log_format: LogFormat = "text",
) -> None:
    """Serve a web console until Ctrl-C: every rig live, services, events, recordings with their reports.

    The console is read-only: it cannot change the bus or a rig.
    """
    import logging
    import platform
    import secrets

    from hilrig_console.auth import AccessPolicy, normalize_host_names
    from hilrig_console.serving import ConsoleServer, TlsFiles, check_health
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.listen_address import ListenAddress
    from hilrig_runtime.process.logging_setup import start_logging
    from hilrig_runtime.process.shutdown import force_exit_after, stop_on_signals, wait_for
    from hilrig_runtime.timing.realtime import lower_priority

    if (certificate is None) != (key is None):
        raise InputError("--certificate and --key must be given together")
    tls = None if certificate is None or key is None else TlsFiles(certificate, key)
    address = ListenAddress.parse(listen)
    if check:
        check_health(address, tls)
        return
    start_logging("console", "1", log_format)
    say = announcer(log_format)
    lab = load_lab(config)
    password = _password(password_file) if password_file is not None else ""
    generated = not password and not address.is_loopback
    if generated:
        password = secrets.token_urlsafe(12)
    names = normalize_host_names([platform.node(), address.host, *(name or [])])
    server = ConsoleServer(lab, address, AccessPolicy(password, names), tls)
    lower_priority()
    stopping = stop_on_signals()
    force_exit_after(stopping, 8.0)
    with server:
        say(f"console of lab {lab.name}: {server.urls}")
        if generated:
            say(f"password: {password} (any user name)")
        if tls is None and not address.is_loopback:
            logging.getLogger(__name__).warning("without --certificate and --key the password is sent unencrypted")
        wait_for(stopping)


def _password(file: Path) -> str:
    from hilrig_console.auth import MIN_PASSWORD_CHARS
    from hilrig_runtime.config.validation import read_text
    from hilrig_runtime.errors import InputError

    try:
        password = read_text(file).partition("\n")[0].strip()
    except InputError as error:
        raise InputError(f"--password-file: {error}") from error
    if len(password) < MIN_PASSWORD_CHARS:
        raise InputError(
            f"--password-file: {file}: the password in the first line must have at least {MIN_PASSWORD_CHARS} "
            f"characters, got {len(password)}"
        )
    return password
