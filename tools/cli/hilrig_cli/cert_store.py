"""A folder of certificates with their keys, signed by one authority: what is there, what is due, what was written."""

import os
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.security.x509 import Credential, load, make_authority, names_in

AUTHORITY: Final = "ca"
RENEWED_BEFORE: Final = timedelta(days=30)
"""What ends so soon is made anew; of short-lived ones the last third."""


class CertificateFolder:
    """`<name>.pem` and `<name>.key` for each name, and `ca.pem` and `ca.key`; made where it is not there.

    Raises:
        InputError: half of its authority is missing, so what it signed can't be added to.
        OperationError: it can't be written.
    """

    def __init__(self, folder: Path, now: datetime, days: int, *, renew: bool = False) -> None:
        self._folder = folder
        self._now = now
        self._days = days
        self._renew = renew
        self.written: list[Path] = []
        self._refuse_half_an_authority()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OperationError(f"{folder}: can't be made: {error.strerror}") from error

    def authority(self, name: str) -> Credential:
        """The folder's authority; a new one, called `name`, where there is none.

        Raises:
            InputError: what is there is none.
        """
        authority = self._read(AUTHORITY)
        if authority is None:
            authority = make_authority(f"{name} {self._now:%Y-%m-%d}", self._now, 10 * self._days)
            self.write(AUTHORITY, authority)
        return authority

    def _refuse_half_an_authority(self) -> None:
        """A host that was given `ca.pem` alone would lose all trust in the others by a new one."""
        certificate, key = (self._folder / f"{AUTHORITY}{suffix}" for suffix in (".pem", ".key"))
        if certificate.exists() == key.exists():
            return
        there, missing = (certificate, key) if certificate.exists() else (key, certificate)
        raise InputError(
            f"{there} has no {missing.name} beside it, so nothing can be signed here: run hilrig certs where the "
            f"authority was made (or take {there} away, and a new authority is made, which nobody trusts yet)"
        )

    def is_due(self, name: str, hosts: Sequence[str] = ()) -> bool:
        """Whether a certificate is missing, about to end, or does not name all of `hosts`."""
        identity = None if self._renew else self._read(name)
        if identity is None:
            return True
        certificate = identity.certificate
        left = certificate.not_valid_after_utc - self._now
        return left < min(RENEWED_BEFORE, timedelta(days=self._days) / 3) or not set(hosts) <= names_in(certificate)

    def names_for(self, name: str, hosts: Sequence[str]) -> list[str]:
        """Host names and addresses for a certificate: `hosts`, and those that the one that is there names."""
        identity = self._read(name)
        before = names_in(identity.certificate) if identity is not None else set()
        return [*hosts, *sorted(before - set(hosts))]

    def write(self, name: str, identity: Credential) -> None:
        """Write a certificate, and its key for its owner's eyes alone."""
        for suffix, data, mode in ((".pem", identity.certificate_pem, 0o644), (".key", identity.key_pem, 0o600)):
            path = self._folder / f"{name}{suffix}"
            try:
                with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
                    file.write(data)
            except OSError as error:
                raise OperationError(f"{path}: can't be written: {error.strerror}") from error
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
                f"{files[0]} and {files[1].name} are no certificate and key that can be used: {error}; "
                "take them away, and they are made anew"
            ) from error
