"""Analysis of recordings of the client role: the controller was a Modbus server."""
