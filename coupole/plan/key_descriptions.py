"""Descriptions of the keys of a plan or a rig: the docstrings under their models' fields, read for a JSON schema.

pydantic's `use_attribute_docstrings` would read them in every process, when a model is made. That took a third of
the time of importing the models of plans and rigs.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from pydantic import BaseModel


def key_descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field that has one. The docstring may be inherited."""
    descriptions: dict[str, str] = {}
    for parent in reversed(model.__mro__):
        if issubclass(parent, BaseModel) and parent is not BaseModel:
            descriptions |= _by_class(inspect.getsourcefile(parent) or "").get(parent.__qualname__, {})
    return descriptions


@lru_cache
def _by_class(path: str) -> dict[str, dict[str, str]]:
    """Return the docstrings of the fields in a file, by class."""
    tree = ast.parse(Path(path).read_text(encoding="utf-8"))
    return {node.name: dict(_docstrings(node)) for node in tree.body if isinstance(node, ast.ClassDef)}


def _docstrings(model: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for field, below in pairwise(model.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str() as docstring)),
            ):
                yield name, inspect.cleandoc(docstring)
