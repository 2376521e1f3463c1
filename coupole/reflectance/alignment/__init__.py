"""Refinement of poses, lens and mesh from the frames, so that all views agree on the object's surface."""
