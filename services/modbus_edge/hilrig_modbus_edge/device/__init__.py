"""One rig as a Modbus device: write access, watchdog, sessions, commands, impairment and events."""
