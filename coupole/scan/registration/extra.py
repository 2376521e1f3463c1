"""The libraries that only registration needs."""

from __future__ import annotations

from typing import Any

from coupole.errors import ExtraMissing


def registration_libraries() -> tuple[Any, Any]:
    """Return `small_gicp` and `kiss_matcher`. Raises ExtraMissing."""
    try:
        import kiss_matcher
        import small_gicp
    except ImportError as error:
        raise ExtraMissing(
            f"registration needs libraries of its own: pip install 'coupole[registration]' ({error})"
        ) from error
    return small_gicp, kiss_matcher
