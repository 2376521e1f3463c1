"""What stands in the simulated dome."""
