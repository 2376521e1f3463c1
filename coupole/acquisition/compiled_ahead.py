"""Compiles the kernels of a run before its devices are open. On a fresh machine this takes seconds to a minute;
otherwise arm, lamps and frames would wait for it."""

from __future__ import annotations

from coupole.acquisition import frame_matching
from coupole.acquisition.opened_cell import told_if_slow
from coupole.acquisition.watching import frame_look
from coupole.motion import occlusion

_WORDS = (
    "compiling the functions that the run will call, once on each machine: a minute or less, "
    "longer on a busy machine ..."
)


def compile_ahead() -> None:
    """Compile all kernels of an acquisition, or load them from numba's cache."""
    with told_if_slow(_WORDS):
        frame_matching.compile_now()
        frame_look.compile_now()
        occlusion.compile_now()
