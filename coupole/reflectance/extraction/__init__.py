"""From a run's proven frames to samples of reflectance on the object's triangles (seed 003, Eqs. 1 to 3, 5.1)."""
