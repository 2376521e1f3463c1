"""Where the arm goes and what it hides: bodies, collisions, paths, order of views, occlusion."""
