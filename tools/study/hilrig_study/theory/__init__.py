"""Theory of the linearized control loop: stability margins, mean-square stability and expected cost."""
