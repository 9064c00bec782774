"""Whether tests that take long run: `make test-long` sets HILRIG_LONG."""

import os
from typing import Final

LONG: Final = bool(os.environ.get("HILRIG_LONG"))
"""Tests with the marker `long` run, and some others repeat more, or for longer."""
