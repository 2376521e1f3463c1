"""Maps of pigments from image cubes and lines of points, and what files say about themselves."""
