"""The plant: a virtual SCARA arm, stepped in real time."""
