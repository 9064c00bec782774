"""The edge as the client of a controller that is a Modbus server."""
