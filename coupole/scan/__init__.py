"""Meshes and target tables as a scanner writes them: readers, checks, import."""
