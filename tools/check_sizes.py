"""Limits on sizes of functions and packages, and unique names of modules; run by `tools/check`.

`python tools/check_sizes.py [ROOT]` prints each violation with its place and exits with 1 if there is one.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

FOLDERS = ("coupole", "drivers", "sim", "tools")
MOST_MODULE_LINES = 400
MOST_FUNCTION_LINES = 60
"""Greatest number of lines of a function, from the first decorator or `def` to the last line, including the
docstring."""
MOST_ROOMS, MOST_TOP_FILES = 19, 9
"""Greatest numbers of packages and of top-level files in coupole/."""
SHARED_NAMES = {"__init__", "records", "report", "settings"}
"""Names that modules of several packages may share."""


def violations(root: Path) -> Iterator[str]:
    """Yield functions that are too large, and module names that occur twice, under `root`, one line each."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            yield from _large(path, path.relative_to(root))
    yield from _shared_module_names(root / "coupole")


def _large(path: Path, shown: Path) -> Iterator[str]:
    text = path.read_text(encoding="utf-8")
    lines = len(text.splitlines())
    if lines > MOST_MODULE_LINES:
        yield f"{shown}: {lines} lines, at most {MOST_MODULE_LINES} are allowed: split it by meaning"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            lines = (node.end_lineno or first) - first + 1
            if lines > MOST_FUNCTION_LINES:
                yield f"{shown}:{first}: {node.name} has {lines} lines, at most {MOST_FUNCTION_LINES} are allowed"


def _shared_module_names(package: Path) -> Iterator[str]:
    rooms_of: dict[str, set[str]] = defaultdict(set)
    for path in package.rglob("*.py"):
        room, *inside = path.relative_to(package).parts
        if inside:
            rooms_of[path.stem].add(room)
    for name, rooms in sorted(rooms_of.items()):
        if len(rooms) > 1 and name not in SHARED_NAMES:
            yield f"{package.name}: {', '.join(sorted(rooms))} each have a module {name}: rename all but one"
    rooms = set().union(*rooms_of.values())
    if len(rooms) > MOST_ROOMS:
        yield f"{package.name}: {len(rooms)} rooms, at most {MOST_ROOMS} are allowed"
    files = len(list(package.glob("*.py")))
    if files > MOST_TOP_FILES:
        yield f"{package.name}: {files} files beside the rooms, at most {MOST_TOP_FILES} are allowed"


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent
    faults = list(violations(root))
    print("\n".join(faults) or "sizes: all within bounds")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
