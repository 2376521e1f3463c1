"""What is said of one burst after its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.acquisition.frame_matching import Match


@dataclass(frozen=True)
class Verdict:
    """Of one burst, after its end."""

    match: Match
    dead: list[str]
    """Shots whose LED drew no current."""


_NONE = np.zeros(0, np.int64)
NOTHING_TO_MATCH = Match(_NONE, _NONE > 0, _NONE > 0, _NONE > 0, ambiguous=False, reason="", clocks=None)
