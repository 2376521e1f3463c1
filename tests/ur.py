"""UR arms need ur-rtde, which has no wheel for every Python."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

NO_WHEEL = "ur-rtde has no wheel for this Python"
needs_ur_rtde = pytest.mark.skipif(find_spec("rtde_control") is None, reason=NO_WHEEL)
