"""Comparison of two states of an object: changes in shape and colour, with their significance."""
