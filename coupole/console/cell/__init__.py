"""Work at the cell: runs that the queue begins, the cell's loan, the bench, calibrations, the present state."""
