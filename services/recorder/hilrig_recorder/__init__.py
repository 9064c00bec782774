"""The recorder: log streams in, one MCAP file a session out."""
