"""Reflectance: from proven frames, or pictures under known lights, to materials that can be lit anew."""
