"""The kinds of service of a lab, in their start and stop orders."""

from typing import Final

SERVICE_KINDS: Final = ("sim", "edge", "recorder")
"""Every kind of service, in start order."""
STOP_ORDER: Final = ("edge", "sim", "recorder")
"""The edge first: it zeroes the torques and ends the sessions. The recorder last: it records both."""
RIG_SERVICES: Final = ("sim", "edge")
"""Kinds of service that keep a list of rigs, which `hilrig rig add` extends."""
