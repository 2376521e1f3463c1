"""The largest permissible error of a length, as it is stated on the command line; without a heavy import."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coupole.errors import InputError


@dataclass(frozen=True)
class Permissible:
    """Largest permissible error of a length L: A + L / K, as ISO 10360-2 states it."""

    constant_mm: float
    per_mm: float

    def at(self, length_mm: float) -> float:
        """The limit of that length, mm."""
        return self.constant_mm + length_mm * self.per_mm


def parse_permissible(words: str) -> Permissible:
    """`A+L/K` or `A`, A in um, K in mm per um. Raises InputError."""
    constant, _, part = words.replace(" ", "").partition("+L/")
    try:
        a, k = float(constant), float(part) if part else math.inf
    except ValueError:
        a, k = math.nan, math.nan
    if not (0 < a < math.inf and k > 0):
        raise InputError(f"--mpe-um {words}: expected A+L/K with A in um and L in mm, as 50+L/20, or A alone")
    return Permissible(1e-3 * a, 1e-3 / k)
