"""Materials of single pixels, finer than the mesh's triangles."""
