"""Which tests may be skipped: where the machine has all that it could have, none but those named here.

A run that skips anything else fails. Real data (`shared/data` beside the project) and what apt-get installs may be
missing on a stranger's machine; then their tests are skipped, and no budget is held.
"""

from __future__ import annotations

import shutil

from checkers import CHECKERS_FAILED
from neighbour_programs import NEIGHBOURS_FAILED
from places import SHARED_DATA
from ur import NO_WHEEL

ALLOWED = (
    "punx, the NeXus validator, is not installed: it wants Qt",
    NO_WHEEL,
    CHECKERS_FAILED,
    NEIGHBOURS_FAILED,
)
"""Reasons that stand for a thing that the machine cannot have."""


def is_complete() -> bool:
    """True where real data, libaravis, a browser and ExifTool are at hand: then nothing else may be skipped."""
    tools = ("arv-tool-0.8", "arv-camera-test-0.8", "chromium", "chromedriver", "exiftool", "cc")
    return SHARED_DATA.is_dir() and all(map(shutil.which, tools))


def over_budget(reasons: dict[str, str]) -> list[str]:
    """A line for each test (by its id, with why it was skipped) that had to run here."""
    if not is_complete():
        return []
    return [f"{test}: {why}" for test, why in reasons.items() if not any(why.endswith(known) for known in ALLOWED)]
