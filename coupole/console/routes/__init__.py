"""The HTTP interface, and its sockets."""
