"""The `[edge.tls]` section of `lab.toml`: Modbus/TCP Security, and the rigs to which each client may write."""

import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final, Literal

from hilrig_runtime.config.types import Port, Section
from hilrig_runtime.errors import InputError, OperationError

ALL_RIGS: Final = "*"
_COMMON_NAME_RULE: Final = (
    "must be the common name of a certificate, without CN=: 1 to 64 letters, digits, blanks and . _ @ -"
)
_COMMON_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9 ._@-]{0,62}[A-Za-z0-9])?")


class TlsConfig(Section):
    """Modbus/TCP Security: each rig listens on a second port with mutual TLS (`hilrig certs`)."""

    certificate: Path
    """The edge's certificate with its chain, PEM."""
    key: Path
    """The certificate's private key, PEM."""
    authority: Path
    """Certificate of the authority that signs the clients' certificates, PEM."""
    first_port: Port = 802
    """Port of the first rig; the others follow."""
    no_role: Literal["operator", "observer", "refuse"] = "observer"
    """Rights of a client whose certificate has no role: operator (write), observer (read) or refuse (no access)."""
    clients: dict[str, tuple[str, ...]] | None = None
    """Names in certificates, and the rigs to which each may write, as {alice = ["rig1"], plc7 = ["*"]}; all others,
    also without TLS, may only read. Read again on SIGHUP. Default: each client may write to every rig if its role
    allows it."""

    def writers_of(self, rig: str) -> frozenset[str] | None:
        """Return the names in the certificates that may write to a rig; None: every client may, by its role."""
        if self.clients is None:
            return None
        return frozenset(name for name, rigs in self.clients.items() if ALL_RIGS in rigs or rig in rigs)

    def check_revoked(self, name: str, where: str) -> None:
        """Check that a client may no longer write; `where` is the name of the file in messages.

        Raises:
            InputError: it is not a name of a certificate.
            OperationError: `clients` lists it, or is missing.
        """
        if not _COMMON_NAME.fullmatch(name):
            raise InputError(f"{name!r} {_COMMON_NAME_RULE}")
        if self.clients is None:
            raise OperationError(
                f"{where} has no [edge.tls.clients], so every certificate may write by its role: add the table with "
                "those that may write"
            )
        if name in self.clients:
            raise OperationError(f"{where} still lists {name}: remove it from [edge.tls.clients] first")

    def mistakes_in_clients(self, rigs: Collection[str]) -> Iterator[str]:
        """Yield each mistake in `clients`, human-readable; `rigs` are those of the lab."""
        clients = self.clients or {}
        spellings = Counter(name.lower() for name in clients)
        for name, its_rigs in clients.items():
            place = f"edge.tls.clients.{name}"
            if not _COMMON_NAME.fullmatch(name):
                yield (f"{place}: {_COMMON_NAME_RULE}")
            if spellings[name.lower()] > 1:
                yield f"{place}: duplicate name; it differs from another one only in upper and lower case"
            if not its_rigs:
                yield f"{place}: must have at least one rig; remove the client if it may only read"
            if ALL_RIGS in its_rigs and len(its_rigs) > 1:
                yield f'{place}: "*" is every rig; remove the other ones'
            for rig, times in Counter(its_rigs).items():
                if times > 1:
                    yield f"{place}: duplicate rig {rig!r}"
                if rig != ALL_RIGS and rig not in rigs:
                    yield f"{place}: unknown rig {rig!r}"
