"""Compiled code: the decorator of its functions, eight numbers at once, and Embree's rays."""

from coupole.kernels.kept_code import kernel

__all__ = ["kernel"]
