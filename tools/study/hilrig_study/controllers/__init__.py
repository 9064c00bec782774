"""Controllers for studies: PID, computed torque, LQR with prediction, and user-written controllers."""
