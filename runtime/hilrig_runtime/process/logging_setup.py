"""What a service logs, on standard error: lines for people, or one JSON object a line for a log collector."""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Any

from hilrig_runtime.errors import InputError


class JsonFormatter(logging.Formatter):
    """One record as one JSON object: time (UTC), level, service, instance, where from, and what."""

    def __init__(self, service: str, instance: str) -> None:
        super().__init__()
        self._identity = {"service": service, "instance": instance}

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        said: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            **self._identity,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            said["exception"] = self.formatException(record.exc_info)
        return json.dumps(said, ensure_ascii=False)


def start_logging(service: str, instance: str, log_format: str) -> None:
    """Log to standard error as `log_format` says, "text" or "json".

    Raises:
        InputError: another format.
    """
    if log_format not in ("text", "json"):
        raise InputError(f"--log-format {log_format!r}: expected text or json")
    handler = logging.StreamHandler(sys.stderr)
    if log_format == "json":
        handler.setFormatter(JsonFormatter(service, instance))
    else:
        who = service if instance == "1" else f"{service} {instance}"
        handler.setFormatter(logging.Formatter(f"{who}: %(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
