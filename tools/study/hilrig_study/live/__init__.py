"""Studies on a running rig, and simulations of recorded conditions."""
