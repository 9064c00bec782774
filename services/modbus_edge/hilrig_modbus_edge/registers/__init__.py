"""The register map: its definition, value encoding, register contents and export."""
