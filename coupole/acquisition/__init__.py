"""Runs a schedule: moves the arm to each view, runs the bursts, proves and records the frames of each burst as it
runs."""
