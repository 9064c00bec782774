"""Repeats experiment (44) of the paper, plots its figures 4, 5 and 6, and compares their numbers with the reference.

    python examples/paper_figures.py --out figures

The integrators are Euler, Dormand-Prince and Runge-Kutta-Fehlberg. Exit code 1: a number differs.
"""

import argparse
import sys
from pathlib import Path

from hilrig_replay.plots.output import check_plot_path, save_figure
from hilrig_sim.validation.paper_figures import compute, draw


def main() -> int:
    """Plot the figures and print the checks; return the exit code."""
    parser = argparse.ArgumentParser(description="Repeat experiment (44) of the paper and plot figures 4, 5 and 6.")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the figures")
    parser.add_argument("--step-ms", type=float, default=20.0, help="step of the fixed-step methods, ms")
    arguments = parser.parse_args()

    found = compute(arguments.step_ms)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, figure in draw(found).items():
        path = arguments.out / name
        check_plot_path(path)
        save_figure(figure, path)
        print(path)
    for name, expected, computed, agrees in found.checks():
        print(f"{'agrees' if agrees else 'DIFFERS'}: {name}: expected {expected}, computed {computed}")
    return 0 if all(agrees for *_, agrees in found.checks()) else 1


if __name__ == "__main__":
    sys.exit(main())
