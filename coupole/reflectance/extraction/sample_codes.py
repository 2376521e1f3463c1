"""Codes of a triangle and an LED: whether there is a sample, or why not."""

from __future__ import annotations

REACHED, AWAY, SHADED, PENUMBRA = range(4)
"""Codes that the object's own shape gives; AWAY: beyond `lamp_sight.MOST_INCIDENCE_DEG`, or behind the LED."""
BY_CELL = PENUMBRA + 1
"""Arm, camera or tool may hide them from each other."""
BY_UNKNOWN = BY_CELL + 1
"""The sample contradicts those beside it (`contradictions`): a thing that nobody described shades it."""
CODES = {
    "reached": REACHED,
    "away": AWAY,
    "shaded": SHADED,
    "penumbra": PENUMBRA,
    "hidden by the cell": BY_CELL,
    "shaded by what is not known": BY_UNKNOWN,
}
