"""Pictures and pages of plans, cells, live frames and runs; the terminal."""
