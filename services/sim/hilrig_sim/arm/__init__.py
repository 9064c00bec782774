"""SCARA arm: parameters, kinematics, dynamics, integration methods and URDF."""
