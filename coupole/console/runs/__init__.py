"""Runs for people: rows of tables, frames, contact sheets, the present run, and results."""
