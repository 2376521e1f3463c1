"""Runs as people look at them: rows, frames, sheets, the one at work, what is made of them."""
