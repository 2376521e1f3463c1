"""Triangles of simple and sculpted bodies, without materials."""
