"""Lists the public names of `import coupole` with their signatures: docs/reference/python-names.txt.

    python tools/list_public_names.py [--output docs/reference/python-names.txt]

Whoever changes the list says what changed in CHANGELOG.md and ends that line with `(Python names DIGEST)`, which
this prints; a test compares both.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import coupole
from coupole.plan.plan import Model

NAMES = Path(__file__).resolve().parent.parent / "docs" / "reference" / "python-names.txt"


def public_names() -> list[str]:
    """Names of the table in coupole/__init__.py, sorted."""
    return sorted([*coupole._NAMES, *coupole._MODULES], key=str.lower)


def listing() -> str:
    """The text of the list."""
    return "".join(f"{line}\n" for name in public_names() for line in _lines(name, getattr(coupole, name)))


def undocumented() -> list[str]:
    """Public names without a docstring; fields are looked for in the source of their class."""
    return [name for name, entry in _entries() if not inspect.getdoc(entry)]


def _entries() -> Iterator[tuple[str, Any]]:
    for name in public_names():
        entry = getattr(coupole, name)
        yield name, entry
        if inspect.isclass(entry):
            yield from ((f"{name}.{member}", value) for member, value in _members(entry) if callable(value))


def _lines(name: str, entry: Any) -> Iterator[str]:
    """A name, and below it what belongs to it."""
    if isinstance(entry, ModuleType):
        yield f"coupole.{name}"
        classes = inspect.getmembers(entry, inspect.isclass)
        yield from (f"    {member}" for member, value in classes if value.__module__ == entry.__name__)
    elif inspect.isclass(entry):
        yield f"coupole.{name}"
        yield from (f"    {member}{_signature(value)}" for member, value in _members(entry))
    else:
        yield f"coupole.{name}{_signature(entry)}"


def _members(entry: type) -> list[tuple[str, Any]]:
    """Public members that this class has itself; fields of a file's format stand in the reference of that file."""
    fields = [] if issubclass(entry, Model) else inspect.get_annotations(entry)
    members = {**dict.fromkeys(fields), **vars(entry)}
    return sorted((name, value) for name, value in members.items() if not name.startswith(("_", "model_")))


def _signature(value: Any) -> str:
    function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    return str(inspect.signature(function)) if inspect.isfunction(function) else ""


def main() -> None:
    parser = argparse.ArgumentParser(description="List the public names of Python.")
    parser.add_argument("--output", type=Path, default=NAMES, help="the list")
    options = parser.parse_args()
    text = listing()
    options.output.write_text(text, encoding="utf-8")
    print(f"(Python names {hashlib.sha256(text.encode()).hexdigest()[:8]})")


if __name__ == "__main__":
    main()
