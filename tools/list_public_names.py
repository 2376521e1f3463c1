"""Lists the public names of `import coupole` with their signatures (docs/reference/python-names.txt), and
describes them by their docstrings (docs/reference/python.md).

    python tools/list_public_names.py

If you change the list, say in CHANGELOG.md what has changed, and end that line with the words that this tool
prints. A test compares them.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import coupole
from coupole.plan.base_model import Model

REFERENCE = Path(__file__).resolve().parent.parent / "docs" / "reference"
NAMES, PAGE = REFERENCE / "python-names.txt", REFERENCE / "python.md"
TAGS = ("event", "kind", "model_config")
HEAD = """\
# Python

All public names of `import coupole`, written by `tools/list_public_names.py` from the docstrings.
[Work from Python](../how-to/from-python.md) shows them at work. The base frame is the robot's; the support frame
has its origin at the disk's centre and z up.
"""


def public_names() -> list[str]:
    """Names of the tables in coupole/__init__.py, sorted."""
    return sorted([*coupole._NAMES, *coupole._MODULES], key=str.lower)


def listing() -> str:
    """Return the text of the list."""
    return "".join(f"{line}\n" for name in public_names() for line in _lines(name, getattr(coupole, name)))


def page() -> str:
    """Return the text of the page."""
    return HEAD + "".join(_section(name, getattr(coupole, name)) for name in public_names())


def undocumented() -> list[str]:
    """Return the public names without a docstring, including fields. Tests of `coupole.testing` are exempt,
    because their names are sentences; so are the tags of events and lights, because their values describe them."""
    members = ((name, name.rpartition(".")[2], docstring) for name, docstring in _documented())
    return [
        name for name, last, docstring in members if not (docstring or last in TAGS or last.startswith("test_"))
    ]


def _documented() -> Iterator[tuple[str, str]]:
    for name in public_names():
        entry = getattr(coupole, name)
        yield name, inspect.getdoc(entry) or ""
        classes = _classes(entry) if isinstance(entry, ModuleType) else []
        yield from ((f"{name}.{member}", vars(value).get("__doc__") or "") for member, value in classes)
        for path, value in [(name, entry), *((f"{name}.{member}", value) for member, value in classes)]:
            if inspect.isclass(value):
                documented_members = _members(value, with_keys=isinstance(entry, ModuleType))
                yield from ((f"{path}.{member}", docstring) for member, _, docstring in documented_members)


def _lines(name: str, entry: Any) -> Iterator[str]:
    """Return a name, and below it the names that belong to it."""
    yield f"coupole.{name}{_signature(entry)}"
    if isinstance(entry, ModuleType):
        yield from (f"    {member}" for member, _ in _classes(entry))
    elif inspect.isclass(entry):
        yield from (f"    {member}{signature}" for member, signature, _ in _members(entry))


def _section(name: str, entry: Any) -> str:
    """Return a name's part of the page."""
    text = f"\n## `coupole.{name}`\n\n"
    if signature := _signature(entry):
        text += f"```python\n{name}{signature}\n```\n\n"
    text += f"{_as_markdown(inspect.getdoc(entry) or '')}\n"
    rows: list[tuple[str, str, str]] = []
    if isinstance(entry, ModuleType):
        rows = [(member, "", inspect.getdoc(value) or "") for member, value in _classes(entry)]
    elif inspect.isclass(entry):
        rows = _members(entry)
    if rows:
        text += "\n| name | is |\n|---|---|\n"
    cells = ((f"`{member}{signature}`", " ".join(docstring.split())) for member, signature, docstring in rows)
    return text + "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |\n" for row in cells)


def _as_markdown(docstring: str) -> str:
    """Return the docstring with its blocks after `::` and its tables as fenced blocks."""
    blocks = re.sub(
        r"^::\n\n((?:(?: {4}.*)?\n)+)",
        lambda block: f"```text\n{textwrap.dedent(block[1]).strip()}\n```\n\n",
        docstring + "\n",
        flags=re.MULTILINE,
    )
    return re.sub(r"^=+  =+\n(?:.+\n)+?=+  =+$", r"```text\n\g<0>\n```", blocks, flags=re.MULTILINE).rstrip()


def _classes(module: ModuleType) -> list[tuple[str, type]]:
    """Return the classes of a module: those that it lists, or those that are defined in it."""
    if listed_names := getattr(module, "__all__", None):
        values = [(name, getattr(module, name)) for name in sorted(listed_names)]
        return [(name, value) for name, value in values if inspect.isclass(value)]
    members = inspect.getmembers(module, inspect.isclass)
    return [(name, value) for name, value in members if value.__module__ == module.__name__]


def _members(entry: type, *, with_keys: bool = False) -> list[tuple[str, str, str]]:
    """Return name, signature and docstring of each public member that this class itself defines. Keys of a file's
    format are described in the reference of that format; they are included only `with_keys`."""
    fields = _fields(entry) if with_keys or not issubclass(entry, Model) else {}
    members: dict[str, tuple[str, str]] = {name: ("", docstring) for name, docstring in fields.items()}
    for name, value in vars(entry).items():
        if name not in fields and not name.startswith("model_"):
            members[name] = _signature(value), inspect.getdoc(value) or ""
    shown = {"__next__"} | {name for name in members if not name.startswith("_")}
    return [(name, *members[name]) for name in sorted(members) if name in shown]


def _fields(entry: type) -> dict[str, str]:
    """Return the docstrings under the annotated names of a class; empty ones for names without."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(entry))).body
    assert isinstance(node, ast.ClassDef)
    docstrings: dict[str, str] = {}
    for statement, below in pairwise([*node.body, ast.Pass()]):
        match statement, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text)):
                docstrings[name] = inspect.cleandoc(text)
            case ast.AnnAssign(target=ast.Name(id=name)), _:
                docstrings[name] = ""
    return docstrings


def _signature(value: Any) -> str:
    """Return the signature of a function as it is written, without quotes."""
    function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    return str(inspect.signature(function)).replace("'", "") if inspect.isfunction(function) else ""


def main() -> None:
    NAMES.write_text(listing(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
    print(f"(Python names {hashlib.sha256(NAMES.read_bytes()).hexdigest()[:8]})")


if __name__ == "__main__":
    main()
