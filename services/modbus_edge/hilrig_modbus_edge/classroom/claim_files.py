"""Files of the folder `classroom.claims`: the codes, which the edge reads, and one file with the claim of each rig."""

import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from hilrig_modbus_edge.device.client import Client
from hilrig_runtime.config.claim_codes import CODES_FILE, ClaimCode, digest_of, read_codes, replace_private_file
from hilrig_runtime.config.types import Name
from hilrig_runtime.errors import InputError

logger = logging.getLogger(__name__)


class Claim(BaseModel):
    """A rig's claim, as it is stored."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    student: Name
    """Id of the student."""
    host: str
    """Address of the machine; with a certificate, only that counts."""
    certificate: str = ""
    """Name in its certificate; empty: it has none."""
    ends_wall_ns: Annotated[int, Field(strict=True, ge=0, lt=1 << 62)]
    """End of the lab slot, ns since 1970-01-01 UTC."""

    @classmethod
    def of(cls, student: str, client: Client, ends_wall_ns: int) -> "Claim":
        """Return the claim of a student from the machine of a connection."""
        return cls(student=student, host=client.host, certificate=client.certificate, ends_wall_ns=ends_wall_ns)

    @property
    def machine(self) -> str:
        """Certificate or address to which it is bound."""
        return f"CN={self.certificate}" if self.certificate else self.host

    def is_made_by(self, client: Client) -> bool:
        """Return whether a connection is of the machine that made it."""
        return client.certificate == self.certificate if self.certificate else client.host == self.host


class CodeBook:
    """The codes of a folder; the file is read again when it has changed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._version: tuple[int, ...] = ()
        self._codes: dict[str, ClaimCode] = {}
        self._read_if_changed()

    def find(self, code: str) -> ClaimCode | None:
        """Return the entry of a typed code; None: it is unknown."""
        self._read_if_changed()
        return self._codes.get(digest_of(code))

    def _read_if_changed(self) -> None:
        path = self._folder / CODES_FILE
        try:
            status = path.stat()
        except OSError as error:
            self._codes, self._version = {}, ()
            logger.warning("%s: %s: no rig can be claimed; make codes with hilrig rig codes", path, error.strerror)
            return
        version = (status.st_mtime_ns, status.st_size, status.st_ino)
        if version == self._version:
            return
        self._version = version
        try:
            self._codes = {code.digest: code for code in read_codes(self._folder)}
            logger.info("%s: %d codes", path, len(self._codes))
        except InputError as error:
            logger.error("%s; the codes that were read before stay valid", error)


class ClaimFiles:
    """Claims that survive a restart of the edge; written by a thread, because a disk may be slow."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="claims")

    def load(self, rig: str) -> Claim | None:
        """Return the stored claim of a rig; None: it has none."""
        path = self._path(rig)
        try:
            return Claim.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a claim"
            logger.warning("%s: %s: %s must be claimed again", path, reason, rig)
            return None

    def save(self, rig: str, claim: Claim | None) -> None:
        """Store the claim of a rig, or that it has none."""
        self._writer.submit(self._write, rig, claim)

    def close(self) -> None:
        """Wait until everything is stored."""
        self._writer.shutdown()

    def _write(self, rig: str, claim: Claim | None) -> None:
        path = self._path(rig)
        try:
            if claim is None:
                path.unlink(missing_ok=True)
            else:
                replace_private_file(path, claim.model_dump_json())
        except OSError as error:
            logger.error("%s: not stored: %s: after a restart of the edge the old state holds", path, error.strerror)

    def _path(self, rig: str) -> Path:
        return self._folder / f"{rig}.json"
