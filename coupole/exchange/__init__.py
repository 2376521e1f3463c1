"""Export to other programs' formats: a module for each, with `encode(picture)`, which gives the file's bytes."""

FORMATS = ("dng", "tiff")
"""What frames can be exported to: the names of these modules, and the suffixes of the files."""
