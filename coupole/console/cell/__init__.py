"""Work at the cell: runs that the queue begins, loans of the cell, the bench, calibrations, the present state."""
