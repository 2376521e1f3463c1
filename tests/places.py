"""Where the tests find the project, and the real data that may lie beside it."""

from __future__ import annotations

from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
SHARED_DATA = REPO.parent / "shared" / "data"
"""Not part of the project: tests that need it are skipped without it."""
