"""Geometry of a rig: frames of the arm, workspace, shapes of the URDF."""
