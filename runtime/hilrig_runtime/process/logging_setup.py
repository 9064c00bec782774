"""Logging of a service to standard error: plain text, or one JSON object per line for a log collector."""

import json
import logging
import sys
import threading
from datetime import UTC, datetime
from typing import Any

from hilrig_runtime.errors import InputError
from hilrig_runtime.escaping import printable
from hilrig_runtime.process.shutdown import ErrorOutput

logger = logging.getLogger(__name__)


class JsonFormatter(logging.Formatter):
    """Formats a record as a JSON object: time (UTC), level, service, instance, logger and message."""

    def __init__(self, service: str, instance: str) -> None:
        super().__init__()
        self._identity = {"service": service, "instance": instance}

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            **self._identity,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=False)


class TextFormatter(logging.Formatter):
    """Formats a record as text; control characters in messages, which contain text of other hosts, are escaped."""

    def __init__(self, service: str, instance: str) -> None:
        source = service if instance == "1" else f"{service} {instance}"
        super().__init__(f"%(asctime)s.%(msecs)03d {source}: %(levelname)s: %(message)s", "%Y-%m-%dT%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (a method of logging)
        """See `logging.Formatter.formatMessage`."""
        record.message = printable(record.message)
        return super().formatMessage(record)


def start_logging(service: str, instance: str, log_format: str) -> None:
    """Start logging to standard error in `log_format`, "text" or "json"; with "json" also warnings and final errors.

    Raises:
        InputError: unknown format.
    """
    if log_format not in ("text", "json"):
        raise InputError(f"--log-format: must be text or json, got {log_format!r}")
    handler = logging.StreamHandler(sys.stderr)
    if log_format == "json":
        handler.setFormatter(JsonFormatter(service, instance))
        logging.captureWarnings(True)
        ErrorOutput.write = staticmethod(_log_final_error)  # type: ignore[method-assign]
        sys.excepthook = lambda kind, error, trace: logger.critical(str(error), exc_info=(kind, error, trace))
        threading.excepthook = _log_crash
    else:
        handler.setFormatter(TextFormatter(service, instance))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def _log_final_error(line: str) -> None:
    logger.error("%s", line.removeprefix("error: "))


def _log_crash(crashed: threading.ExceptHookArgs) -> None:
    name = "unknown" if crashed.thread is None else crashed.thread.name
    logger.critical("thread %r crashed", name, exc_info=crashed.exc_value)
