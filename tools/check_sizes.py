"""Limits on sizes of functions and packages, on numbers of parameters, and unique names of modules; run by
`tools/check`.

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
MOST_PARAMETERS = 7
"""Greatest number of parameters of a function, without `self` and `cls`. What travels together is one value."""
KERNELS = {"kernel", "njit"}
"""Decorators of compiled functions, which take arrays and numbers instead of values."""
COMMANDS = "coupole/commands"
"""Folder of the command line: the parameters of a command are its options."""
MANY_PARAMETERS = {"coupole/scripting/analyses.py: fit_reflectance"}
"""Functions that may have more parameters: a public name, whose keywords are those of the command's options."""
MOST_ROOMS, MOST_TOP_FILES = 20, 10
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
    tree = ast.parse(text)
    commands = {id(node) for node in tree.body} if shown.parent.as_posix() == COMMANDS else set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            is_command = id(node) in commands and not node.name.startswith("_")
            count = _parameters(node)
            if count > MOST_PARAMETERS and not (
                is_command or _is_kernel(node) or f"{shown}: {node.name}" in MANY_PARAMETERS
            ):
                place = f"{shown}:{node.lineno}: {node.name}"
                yield f"{place} has {count} parameters, at most {MOST_PARAMETERS} are allowed"
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            lines = (node.end_lineno or first) - first + 1
            if lines > MOST_FUNCTION_LINES:
                yield f"{shown}:{first}: {node.name} has {lines} lines, at most {MOST_FUNCTION_LINES} are allowed"


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    places, more = [*node.args.posonlyargs, *node.args.args], [node.args.vararg, node.args.kwarg]
    is_method = bool(places) and places[0].arg in ("self", "cls")
    return len(places) + len(node.args.kwonlyargs) + sum(argument is not None for argument in more) - is_method


def _is_kernel(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    calls = (decorator.func if isinstance(decorator, ast.Call) else decorator for decorator in node.decorator_list)
    return any(ast.unparse(call).rpartition(".")[2] in KERNELS for call in calls)


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
    files = sum(path.stem != "__main__" for path in package.glob("*.py"))
    if files > MOST_TOP_FILES:
        yield f"{package.name}: {files} files beside the rooms, at most {MOST_TOP_FILES} are allowed"


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent
    faults = list(violations(root))
    print("\n".join(faults) or "sizes: all within bounds")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
