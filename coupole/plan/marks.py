"""Dark marks at both ends of a burst: what tells that its lights are the right ones.

*Coded* marks stand round a burst that the box runs: their periods tell where the burst begins and ends
(`coupole.acquisition.frame_matching`). *Plain* ones stand round a burst that the host fires with a box that keeps
no log: they must be dark, or a lamp shines that nobody asked for.
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
"""Sixteenths of the burst's period that each start mark takes longer. Counted back from the first light the
marks stand at phases 13, 11, 7, 6, 1 of 16: nowhere on the lights' grid, and all different."""
END_MARK_EXTRA = (2, 5, 1, 3, 1)
"""The same for the last light and the end marks but one: phases 2, 7, 8, 11, 12 behind the grid."""
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
    """Put marks round a burst's own steps (STEP_DTYPE [n]), each a `dark` step ([1]) but for its period, which is
    that of all other steps; table and labels with them."""
    count_start, count_end = MARKS_AT_ENDS[kind]
    inner = steps.copy()
    inner["period_us"] = dark["period_us"]
    table = np.concatenate([np.repeat(dark, count_start), inner, np.repeat(dark, count_end)])
    if kind == "coded":
        unit_us = -(-int(dark["period_us"][0]) // MARK_UNITS)
        table["period_us"][:count_start] += np.array(START_MARK_EXTRA) * unit_us
        table["period_us"][-count_end - 1 : -1] += np.array(END_MARK_EXTRA) * unit_us
    return table, [*mark_labels[:count_start], *labels, *mark_labels[count_start:]]
