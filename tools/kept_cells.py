"""A file of judged cells, one JSON line each, so that a proof can be made in parts."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any


def read_cells(path: Path | None) -> Iterator[dict[str, Any]]:
    """Yield the cells of earlier calls; `key` of each says which it is. There are none without a file."""
    if path is not None and path.exists():
        yield from map(json.loads, path.read_text(encoding="utf-8").splitlines())


def keep_cell(path: Path | None, key: Sequence[str | float], judgement: Any) -> None:
    """Append a cell to the file, if there is one. `judgement` is a dataclass."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, **asdict(judgement)}) + "\n")
