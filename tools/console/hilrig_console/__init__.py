"""The lab as people watch it: what its services say of themselves, put together, and a page of it for browsers."""
