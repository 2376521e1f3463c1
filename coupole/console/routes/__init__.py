"""The HTTP interface, and where it listens."""
