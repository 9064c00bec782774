"""Checks that texts use the standard terms of docs/glossary.md: reports each forbidden expression with its place.

Checked are comments, docstrings and messages (every string literal) of Python files, and whole files of the other
kinds. Exit code 1: an expression was found.
"""

import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
FORBIDDEN: Final = {
    r"\bwhat (is|was|has|are|were|had|came|comes|stands|goes|can|could|it|they|a|an|the|of|each|every|one|we)\b": (
        "a noun"
    ),
    r"\bwhoever\b|\bwho (is|are|was|has|have|does|do|may|must|can|comes?|goes|asks?|reads?|writes?|says?|sends?|"
    r"holds?|listens?|looks?|hears?|waits?|wants?|takes?|runs?|serves?|sees?|uses?|keeps?|makes?|gets?)\b": (
        "the client, process, …"
    ),
    r"\b(stands?|stood) (in|on|with|there|behind|beside|for)\b": "is in, is stored in",
    r"\b(has|have|had) come\b": "arrived, received",
    r"\btroubles?\b": "alert, error",
    r"\b(go|goes|going|went|gone) on\b": "continue, resume, proceed",
    r", for (it|they|he|she|there|nobody|nothing|this|these)\b": "because",
    r"\b(is|are|was|were|be) (told|said)\b|\btold of\b|\btells? of\b|\btell(s|ing)? people\b": "is reported, logged",
    r"\banew\b": "again, re-",
    r"\bby hand\b": "manual, manually",
    r"\b(taken?|takes|took|taking) away\b": "removed, steal time, revoked",
    r"\bfor people\b": "human-readable",
    r"\b(is|are) none\b|\bis no valid\b|\bare no valid\b": "is not a valid",
    r"\bon (its|their|the) way\b": "in flight",
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\b(for|may|so) so long\b|\bso long (before|after|as|that|at)\b|\bfor so\b": "name the number",
    r"\bnothing (taken|stolen)\b": "without CPU steal",
    r"\belders?\b": "older instance",
    r"(?<!-)\b(he|his|him|she|her)\b": "it",
    r"\bcan't be had\b": "is unavailable",
    r"\bsee the module\b": "one line",
    r"(?<!Math\.)\bfloors?\b(?!\()(?! (of|at) (the )?(scene|plant|world))": "layer",
    r"\bthe way of\b|\bof the house\b": "data flow",
    r"\b(colour|centre|metre|millimetre|behaviour|neighbour|authoris|quantis|analys(e|ed|ing)\b|catalogue|grey\b|"
    r"synchronis|linearis|recognis|organis|initialis|normalis|minimis|maximis|optimis|serialis|discretis|summaris|"
    r"acknowledgement|favour|honour|labelled\b|modelled|travelled|signalled|cancelled|towards|whilst|licence)": (
        "American spelling"
    ),
}
"""Expression → what to write instead."""
KINDS: Final = {".py", ".md", ".proto", ".js", ".html", ".css", ".toml", ".yaml", ".c", ".sh", ".st", ".cfg", ""}
EXEMPT: Final = ("docs/glossary.md", "scripts/check_vocabulary.py", "LICENSE", "constraints.txt")
PINNED_NAMES: Final = re.compile(r"\b(colour|(table_)?centre(_mm)?)\b(?! of)|delayed_acknowledgement")
"""Keys of lab.toml and of recordings, which keep their spelling."""
_PATTERNS: Final = [(re.compile(pattern, re.IGNORECASE), instead) for pattern, instead in FORBIDDEN.items()]


def main() -> int:
    """Print each forbidden expression under the given path prefixes, and the counts on standard error."""
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    under = tuple(sys.argv[1:])
    counts: Counter[str] = Counter()
    for name in names:
        path = ROOT / name
        skip = name in EXEMPT or "_pb2" in name or "/vendor/" in name or path.suffix not in KINDS or not path.is_file()
        if skip or (under and not name.startswith(under)):
            continue
        for line, found_text in _texts(path):
            text = PINNED_NAMES.sub("", found_text)
            for pattern, instead in _PATTERNS:
                for found in pattern.finditer(text):
                    at = line + text.count("\n", 0, found.start())
                    print(f"{name}:{at}: {' '.join(found[0].split())!r}: write {instead}")
                    counts[instead] += 1
    for instead, count in counts.most_common():
        print(f"{count:6} {instead}", file=sys.stderr)
    return 1 if counts else 0


def _texts(path: Path) -> Iterator[tuple[int, str]]:
    """Pieces of text of a file, each with its first line's number."""
    source = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield 1, source
        return
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            yield token.start[0], token.string


if __name__ == "__main__":
    sys.exit(main())
