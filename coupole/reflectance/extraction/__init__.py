"""Samples of reflectance on the object's triangles, from a run's proven frames (Lucat et al. 2025, Eqs. 1 to 3,
5.1)."""
