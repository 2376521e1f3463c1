"""Results of runs for other programs: a module for each format, with `write(surface, folder)`, which returns the
written files."""
