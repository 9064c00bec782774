"""Register map: definition, value encoding, register image and export."""
