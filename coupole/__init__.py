"""Acquisition controller of La Coupole: plans in, proven frames out."""

__version__ = "0.1.0"
