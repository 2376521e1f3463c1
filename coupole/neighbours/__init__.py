"""Cells, runs and results of Coupole in other programs: bluesky with Tiled, and napari."""
