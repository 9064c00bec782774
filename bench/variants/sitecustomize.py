"""Applies a variant of the ablation study to the Python processes that `bench/ablation.py` starts.

Python imports a module of this name at startup if its folder is on PYTHONPATH.
"""

import os

if name := os.environ.get("HILRIG_BENCH_VARIANT"):
    from variants import VARIANTS

    for disable in VARIANTS[name]:
        disable()
