"""Owners of rigs: the students of a roster, and claims with codes (docs/adr/0061-claims-are-made-over-modbus.md)."""
