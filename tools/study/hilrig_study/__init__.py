"""How much delay, jitter and loss a controller bears: theory, the loop in virtual time, and the live loop beside it."""
