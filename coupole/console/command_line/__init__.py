"""The command line as a client of the console that owns a cell."""
