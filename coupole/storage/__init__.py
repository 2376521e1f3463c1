"""Stored data: run folder, journal, frame files, archive."""
