"""The simulated plant: the arm with its hard stops, joint limits and the parts around it."""
