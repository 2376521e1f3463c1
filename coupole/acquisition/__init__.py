"""Runs a schedule: moves the arm to each view, runs bursts, proves frames while a burst runs, and records them."""
