"""Findings of a watched run, with their names and contents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.frame_look import FrameLook
from coupole.plan.shot_id import ShotLabel

Kind = Literal["ambient light", "LED", "drift", "moved", "smudge", "exposure step", "thing in the field"]
OF_THE_LIGHT = "of the light"
"""Unit of changes of brightness."""
FOR_A_PERSON: tuple[Kind, ...] = ("ambient light", "moved", "smudge")
"""Findings that last until a person removes the cause."""
TAKEN_AGAIN: tuple[Kind, ...] = ("ambient light", "LED", "thing in the field")
"""Findings whose shots may be good if they are taken again."""

NOT_WATCHED = "not watched"
"""Kind of the journal's line that says that watching itself has failed, completely or in part."""


@dataclass(frozen=True)
class SeenFrame:
    """A frame of a burst, in the order of time."""

    label: ShotLabel
    look: FrameLook


@dataclass(frozen=True)
class Found:
    """Something that changed in a burst but should not have changed."""

    kind: Kind
    labels: tuple[ShotLabel, ...]
    """Shots that it concerns."""
    figure: float
    limit: float
    unit: str
    words: str
    """Description of the change, in a sentence."""
    before: NDArray[np.float32]
    """[rows, columns] look to compare with, DN."""
    after: NDArray[np.float32]
    """[rows, columns] look that differs, DN."""
