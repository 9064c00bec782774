"""What every process stands on: clock, rate, lifecycle, configuration, bus, log stream, health, service."""
