"""Processes that compute for a console, and their output."""
