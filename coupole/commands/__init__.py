"""The commands of the command line, by subject. Each reads its input, calls the room that does the work, and
prints the result."""
