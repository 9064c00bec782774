"""Certificate store: a folder with certificates and keys, signed by one certificate authority."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from hilrig_replay.io.output_file import output_file
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.security.x509 import Credential, load, make_authority, names_in

AUTHORITY_NAME: Final = "ca"
RENEWAL_PERIOD: Final = timedelta(days=30)
"""Remaining validity below which a certificate is renewed; a third of the validity if that is shorter."""


class CertificateStore:
    """Stores `<name>.pem` and `<name>.key` for each name, and `ca.pem` and `ca.key`; creates the folder.

    Raises:
        InputError: the authority has a certificate without its key, or a key without its certificate.
        OperationError: the folder can't be created.
    """

    def __init__(self, folder: Path, now: datetime, days: int, *, renew: bool = False) -> None:
        self._folder = folder
        self._now = now
        self._days = days
        self._renew = renew
        self.written: list[Path] = []
        self._check_authority_complete()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise OperationError(f"{folder}: expected a folder, found a file") from error
        except OSError as error:
            raise OperationError(f"{folder}: can't be created: {error.strerror}") from error

    def authority(self, name: str) -> Credential:
        """Return the folder's authority; create one with the common name `name` if it is missing.

        Raises:
            InputError: the existing authority is not valid.
        """
        authority = self._read(AUTHORITY_NAME)
        if authority is None:
            authority = make_authority(f"{name} {self._now:%Y-%m-%d}", self._now, 10 * self._days)
            self.write(AUTHORITY_NAME, authority)
        return authority

    def _check_authority_complete(self) -> None:
        """Refuse half an authority: a new one on a host that has `ca.pem` only would invalidate all certificates."""
        certificate, key = (self._folder / f"{AUTHORITY_NAME}{suffix}" for suffix in (".pem", ".key"))
        if certificate.exists() == key.exists():
            return
        present, missing = (certificate, key) if certificate.exists() else (key, certificate)
        raise InputError(
            f"{present} has no {missing.name} in the same folder, so no certificate can be signed: run hilrig certs "
            f"where the authority was created (or delete {present} to create a new authority, which no host trusts yet)"
        )

    def is_due(self, name: str, hosts: Sequence[str] = ()) -> bool:
        """Whether a certificate is missing, is about to expire, or does not name all of `hosts`."""
        identity = None if self._renew else self._read(name)
        if identity is None:
            return True
        certificate = identity.certificate
        remaining = certificate.not_valid_after_utc - self._now
        expires = remaining < min(RENEWAL_PERIOD, timedelta(days=self._days) / 3)
        return expires or not set(hosts) <= names_in(certificate)

    def host_names(self, name: str, hosts: Sequence[str]) -> list[str]:
        """Host names and addresses for a certificate: `hosts` and those of the existing certificate."""
        identity = self._read(name)
        existing = names_in(identity.certificate) if identity is not None else set()
        return [*hosts, *sorted(existing - set(hosts))]

    def write(self, name: str, identity: Credential) -> None:
        """Write a certificate and its key; the key is readable by its owner only."""
        for suffix, data, mode in ((".pem", identity.certificate_pem, 0o644), (".key", identity.key_pem, 0o600)):
            path = self._folder / f"{name}{suffix}"
            with output_file(path, mode=mode) as temporary:
                temporary.write_bytes(data)
            self.written.append(path)

    def _read(self, name: str) -> Credential | None:
        files = [self._folder / f"{name}{suffix}" for suffix in (".pem", ".key")]
        if not all(path.exists() for path in files):
            return None
        try:
            return load(*(path.read_bytes() for path in files))
        except OSError as error:
            raise OperationError(f"{error.filename}: can't be read: {error.strerror}") from error
        except ValueError as error:
            raise InputError(
                f"{files[0]}, {files[1].name}: not a valid certificate with its key: {error}; "
                "delete both files to create them again"
            ) from error
