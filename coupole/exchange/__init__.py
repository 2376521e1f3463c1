"""Export to the formats of other programs; `formats` has the table of all formats."""
