"""The order in which the services of a lab stop, and those that have rigs; `topics.SERVICES` is their start order."""

from typing import Final

STOP_ORDER: Final = ("edge", "sim", "recorder")
"""The edge first: it zeroes the torques and ends the sessions. The recorder last: it records both."""
RIG_SERVICES: Final = ("sim", "edge")
"""Kinds of service that keep a list of rigs, which `hilrig rig add` extends."""
