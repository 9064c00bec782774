"""Monotonic time: clocks, periodic deadlines and real-time scheduling."""
