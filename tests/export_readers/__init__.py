"""Readers of exports of results, by others' libraries or from a layout: one module for each format, by its name.

A reader has `MOST_LOST`, the greatest relative error that 95 % of its values may have, and one of three functions:

    relit(folder, lit) -> [n, 3]              pixels of the whole surface under one light each
    evaluate(path, light, camera) -> [n, 3]   pi f cos_i of the table of one material, unit directions [n, 3]
    values(path) -> [n]                       samples of one triangle and channel, 1/sr

`tools/prove_exports.py` takes every format that has a reader; `tests/exchange/test_exports_of_results.py` holds
those of the whole surface to their `MOST_LOST`.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from coupole.exchange.formats import Source, Writer, formats_of


def readers_with(function: str) -> dict[str, Any]:
    """Readers that have a function of this name, by format, in the order of the formats."""
    names = [name for name in formats_of(Source.RESULT, Writer.RESULT) if (_HERE / f"{name}.py").exists()]
    readers = {name: importlib.import_module(f"export_readers.{name}") for name in names}
    return {name: reader for name, reader in readers.items() if hasattr(reader, function)}


_HERE = Path(__file__).parent
