"""Export to other programs' formats: a module for each, with `encode(picture)`, which gives the file's bytes."""

FORMATS = ("dng", "tiff")
"""What frames can be exported to: the names of these modules, and the suffixes of the files."""
COLMAP = "colmap"
"""What views are exported to with their poses (`coupole.exchange.colmap`)."""
CRATE = "rocrate"
"""What wraps a run or a result of runs with what is to be known of it (`coupole.exchange.research_crate`)."""
