"""The largest permissible error of a length, as it is written on the command line. This module has no heavy
import."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coupole.errors import InputError


@dataclass(frozen=True)
class Permissible:
    """Largest permissible error of a length L: A + L / K, in the form of ISO 10360-2."""

    constant_mm: float
    per_mm: float

    def at(self, length_mm: float) -> float:
        """Return the limit for this length, mm."""
        return self.constant_mm + length_mm * self.per_mm


def parse_permissible(words: str) -> Permissible:
    """Read `A+L/K` or `A`, with A in um and K in mm per um. Raises InputError."""
    constant, _, part = words.replace(" ", "").partition("+L/")
    try:
        a, k = float(constant), float(part) if part else math.inf
    except ValueError:
        a, k = math.nan, math.nan
    if not (0 < a < math.inf and k > 0):
        raise InputError(f"--mpe-um {words}: expected A+L/K with A in um and L in mm, as 50+L/20, or A alone")
    return Permissible(1e-3 * a, 1e-3 / k)
