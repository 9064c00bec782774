"""Recordings read back: arrays, latency, pictures. In a notebook: `from hilrig_replay import open_run`."""

from hilrig_replay.io.run import Run, open_run

__all__ = ["Run", "open_run"]
