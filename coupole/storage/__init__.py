"""What is on disk: run folder, journal, frame files, archive."""
