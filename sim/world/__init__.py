"""The shared state of the simulated cell, its clock, its faults, and the process that runs it."""
