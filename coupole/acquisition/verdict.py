"""The result of one burst after its end, and its kind of proof."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coupole.acquisition.frame_matching import Match
from coupole.plan.marks import Marks
from coupole.plan.shot_id import ShotId

PROOF_BY: dict[Marks, str] = {
    "coded": "box log and camera counters",
    "none": "one light, one exposure, one frame; box log",
    "plain": "one light, one exposure, one frame; host's clock",
}
"""The kind of proof that a run states, by the marks of its bursts. The strongest proof is first, the weakest last
(docs/reference/run-folder.md)."""


@dataclass(frozen=True)
class Verdict:
    """The result of one burst after its end."""

    match: Match
    dead: list[ShotId]
    """Shots whose LED drew no current."""

    def because(self, reason: str) -> Verdict:
        """Return the same verdict, with another reason for unproven frames if there are any."""
        return replace(self, match=replace(self.match, reason=reason)) if reason else self


_NONE = np.zeros(0, np.int64)
NOTHING_TO_MATCH = Match(_NONE, _NONE > 0, _NONE > 0, _NONE > 0, ambiguous=False, reason="", clocks=None)
