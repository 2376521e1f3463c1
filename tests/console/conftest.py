"""Puts this folder on the path, so that tests of all parts of the console share `served` and `at_the_console`."""
