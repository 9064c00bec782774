"""Certificates and keys for TLS."""
