"""One rig as a Modbus device: write access, the watchdog, sessions, commands and events."""
