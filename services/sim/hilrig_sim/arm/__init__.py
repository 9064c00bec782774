"""The SCARA arm: parameters, kinematics, dynamics, integration methods and the URDF."""
