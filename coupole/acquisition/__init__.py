"""Runs a schedule: arm to a view, a burst in the box, frames proved while it runs, recorded."""
