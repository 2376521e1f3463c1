"""Paths inside a run's folder, as its own files name them. Such a path cannot lead out of the folder."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Annotated

from pydantic import AfterValidator


def inner(text: str) -> str:
    """Return the path itself. Raises ValueError if it is absolute, goes up, or is not a path."""
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or "\0" in text or not path.parts:
        raise ValueError("expected a path below the run's folder")
    return text


InnerPath = Annotated[str, AfterValidator(inner)]
