"""Recordings on disk: segment files, synchronization, disk space and retention."""
