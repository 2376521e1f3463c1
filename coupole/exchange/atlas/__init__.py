"""Flat maps of a measured surface: charts, their places in a texture, and the triangle that each texel shows."""
