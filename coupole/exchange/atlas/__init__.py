"""Flat maps of a measured surface: charts, their places in a texture, and what each texel shows."""
