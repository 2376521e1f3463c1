"""Codes of a triangle and an LED: they say whether there is a sample, or why there is none."""

from __future__ import annotations

REACHED, AWAY, SHADED, PENUMBRA = range(4)
"""Codes that follow from the object's own shape. AWAY: the incidence is beyond `lamp_sight.MOST_INCIDENCE_DEG`, or
the triangle is behind the LED."""
BY_CELL = PENUMBRA + 1
"""Arm, camera or tool may hide the LED from the triangle."""
BY_UNKNOWN = BY_CELL + 1
"""The sample contradicts the samples beside it (`contradictions`), because a thing that nobody described shades
it."""
CODES = {
    "reached": REACHED,
    "away": AWAY,
    "shaded": SHADED,
    "penumbra": PENUMBRA,
    "hidden by the cell": BY_CELL,
    "shaded by something unknown": BY_UNKNOWN,
}
