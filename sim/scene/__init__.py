"""The simulated scene in the dome."""
