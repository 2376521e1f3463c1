"""Photographs of one scene with several exposure times, merged into one picture with linear values."""
