"""Platform fingerprint: processor, vector units, Python and numpy, which the last bits of a simulation depend on."""

import platform

import numpy as np


def machine_name() -> str:
    """Return the platform as one human-readable line; platforms with the same line compute bit-identical steps."""
    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})
    units = sorted({*simd.get("baseline", []), *simd.get("found", [])})
    vectors = f" ({' '.join(units)})" if units else ""
    return (
        f"{platform.system()} {platform.machine()}{vectors}, Python {platform.python_version()}, numpy {np.__version__}"
    )
