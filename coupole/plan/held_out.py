"""LEDs whose frames are not used for fits, but to check the fits."""

from __future__ import annotations

from collections.abc import Collection

HELD_OUT_EVERY, HELD_OUT_FIRST = 12, 4
"""Step and first place of the LEDs that are kept for the check, if the user names none."""


def held_out_leds(leds: Collection[int]) -> list[int]:
    """Return the LEDs that are kept for the check among all LEDs of a run, if the user names none."""
    return sorted(leds)[HELD_OUT_FIRST::HELD_OUT_EVERY]
