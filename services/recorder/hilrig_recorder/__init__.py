"""The recorder: writes the recording streams of the services into one MCAP file per session."""
