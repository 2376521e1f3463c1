"""Reflectance: from proven frames, or from pictures under known lights, to materials that can be lit by new
lights."""
