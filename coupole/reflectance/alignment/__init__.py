"""Views of an object brought to agree on its surface: poses, lens and mesh refined together from the frames."""
