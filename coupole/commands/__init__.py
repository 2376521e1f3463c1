"""The commands of the command line, one module for each subject. A command reads its input, calls the package that
does the work, and prints the result."""
