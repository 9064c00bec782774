"""What the last bits of a simulation depend on: processor, its vector units, Python, numpy."""

import platform

import numpy as np


def machine_name() -> str:
    """This machine and its software as one line for people; machines of one name step a plant to the same bits."""
    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})
    units = sorted({*simd.get("baseline", []), *simd.get("found", [])})
    vectors = f" ({' '.join(units)})" if units else ""
    return (
        f"{platform.system()} {platform.machine()}{vectors}, Python {platform.python_version()}, numpy {np.__version__}"
    )
