"""From recording streams to the messages of a session: queue, sessions and pre-roll."""
