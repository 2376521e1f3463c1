"""Dark marks at both ends of a burst, for the proof of its frames.

*Coded* marks enclose a burst that the box runs: their periods identify the burst's beginning and end
(`coupole.acquisition.frame_matching`). *Plain* marks enclose a burst that the host fires, because the box has no
log. Marks must be dark; otherwise a lamp is on that should be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

L = TypeVar("L")
Marks = Literal["coded", "plain", "none"]

MARK_UNITS = 16
START_MARK_EXTRA = (5, 1, 4, 2, 3)
"""Additional period of each start mark, in sixteenths of the burst's period. Counted back from the first light,
the marks have the phases 13, 11, 7, 6, 1 of 16. The phases are all different, and never on the lights' grid."""
END_MARK_EXTRA = (2, 5, 1, 3, 1)
"""The same for the end marks except the last one, counted from the last light. The phases of the end marks are 2,
7, 8, 11, 12 after the grid.
"""
MARKS = len(START_MARK_EXTRA) + len(END_MARK_EXTRA)
MARKS_AT_ENDS: dict[Marks, tuple[int, int]] = {
    "coded": (len(START_MARK_EXTRA), len(END_MARK_EXTRA)),
    "plain": (1, 1),
    "none": (0, 0),
}
"""Number of marks at the start and at the end."""


def with_marks(
    kind: Marks, steps: NDArray[np.void], labels: Sequence[L], mark_labels: Sequence[L], dark: NDArray[np.void]
) -> tuple[NDArray[np.void], list[L]]:
    """Add marks before and after a burst's steps (STEP_DTYPE [n]). Each mark is the `dark` step ([1]) with the
    period of the other steps; the period of a coded mark is longer. Returns table and labels.
    """
    count_start, count_end = MARKS_AT_ENDS[kind]
    inner = steps.copy()
    inner["period_us"] = dark["period_us"]
    table = np.concatenate([np.repeat(dark, count_start), inner, np.repeat(dark, count_end)])
    if kind == "coded":
        unit_us = -(-int(dark["period_us"][0]) // MARK_UNITS)
        table["period_us"][:count_start] += np.array(START_MARK_EXTRA) * unit_us
        table["period_us"][-count_end - 1 : -1] += np.array(END_MARK_EXTRA) * unit_us
    return table, [*mark_labels[:count_start], *labels, *mark_labels[count_start:]]
