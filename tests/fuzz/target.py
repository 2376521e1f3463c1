"""What a fuzz target is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Target:
    """One kind of file, or one wire."""

    name: str
    file: str
    """Where a mutated file is put, relative to the folder with the copy of `configs/`."""
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    """Gets the mutated file's path."""
    beside: Callable[[Path], object] | None = None
    """Makes what the file's reader needs beside it, in the given folder; called once."""
    names_file: bool = True
    """Whether a refusal must name the file. Bytes on a wire come from a device."""
