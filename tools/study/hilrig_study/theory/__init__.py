"""Theory of the control loop: linear models, stability margins and expected cost."""
