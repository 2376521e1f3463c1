"""Export to other programs' formats (`formats`: the table of them all)."""
