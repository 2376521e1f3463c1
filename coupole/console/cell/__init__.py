"""What happens at the cell: runs that the queue begins, its loan, the bench, calibrations, its state now."""
