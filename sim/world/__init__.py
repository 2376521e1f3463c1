"""The simulated cell's shared state, clock and faults, and the process that runs it."""
