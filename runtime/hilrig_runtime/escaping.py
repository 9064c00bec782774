"""Escapes text from outside (file names, recordings, other hosts) for its renderer.

A terminal executes control characters, matplotlib sets text between dollar signs as mathematics, a spreadsheet executes
cells that begin with an equals sign, and no encoder accepts the surrogates of undecodable file names.
"""

from html import escape
from typing import Final

_FORMULA_BEGINNINGS: Final = ("=", "+", "-", "@", "\t", "\r")
_JOINERS: Final = "\u200c\u200d"
"""Format characters that are part of words, as in Persian and Sinhala names."""


def printable(text: str, keep: str = "") -> str:
    r"""Replace control, format and undecodable characters by their escapes, such as \x1b; those in `keep` are kept."""
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or letter in keep or letter in _JOINERS or (letter.isspace() and letter > "\x9f")
        else _escape(letter)
        for letter in text
    )


def _escape(letter: str) -> str:
    code = ord(letter)
    # Python represents an undecodable byte of a file name by a surrogate.
    code = code - 0xDC00 if 0xDC80 <= code <= 0xDCFF else code
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def as_html(text: str) -> str:
    """Text for the content of an HTML element, or for an attribute in quotation marks."""
    return escape(printable(text, keep="\n"), quote=True)


def plot_text(text: str) -> str:
    """Text for a figure of matplotlib."""
    return printable(text, keep="\n").replace("$", r"\$")


def csv_text(text: str) -> str:
    """Text for a cell of a CSV table. An apostrophe before a formula makes spreadsheets show it as text."""
    return f"'{text}" if text.startswith(_FORMULA_BEGINNINGS) else text
