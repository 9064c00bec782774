"""Applies a variant of the ablation to every Python process that `bench/ablation.py` starts.

Python imports a module of this name at start-up when its folder is on PYTHONPATH.
"""

import os

if name := os.environ.get("HILRIG_BENCH_VARIANT"):
    from variants import VARIANTS

    for disable in VARIANTS[name]:
        disable()
