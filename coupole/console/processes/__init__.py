"""Processes that compute for a console, and what they print."""
