"""TLS context of connections to a controller."""

import ssl

from hilrig_runtime.config.controller import ClientTlsConfig
from hilrig_runtime.errors import InputError


def client_context(tls: ClientTlsConfig) -> ssl.SSLContext:
    """Return the context of a client with mutual authentication.

    Raises:
        InputError: a file can't be read or is no PEM file.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_verify_locations(tls.authority)
    except (ssl.SSLError, OSError) as error:
        raise InputError(f"client.tls.authority: {tls.authority} contains no PEM certificates: {error}") from error
    try:
        context.load_cert_chain(tls.certificate, tls.key, password=lambda: "")
    except (ssl.SSLError, OSError) as error:
        raise InputError(
            f"client.tls: certificate {tls.certificate} and key {tls.key} do not match, or are not PEM files without a "
            f"password: {error}"
        ) from error
    return context
