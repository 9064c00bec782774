"""Scripts and style of report pages, and the policy under which a browser runs them."""

from base64 import b64encode
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import Final

_UPLOT: Final = "vendor/uplot-1.6.32"


def scripts() -> tuple[str, ...]:
    """Scripts of a page, in order."""
    return _asset(f"{_UPLOT}/uPlot.iife.min.js"), _asset("static/report.js")


def style() -> str:
    """Style sheet of a page."""
    return _asset(f"{_UPLOT}/uPlot.min.css") + _asset("static/report.css")


def license_text() -> str:
    """License of the scripts of other projects."""
    return "uPlot, " + _asset(f"{_UPLOT}/LICENSE")


def content_policy() -> str:
    """Content security policy of a page: only its own scripts run, and nothing is fetched."""
    hashes = " ".join(f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in scripts())
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
        "form-action 'none'"
    )


@cache
def _asset(name: str) -> str:
    return (files("hilrig_replay.report") / name).read_text(encoding="utf-8")
