"""Analysis for conservation: materials of an object from measurements."""
