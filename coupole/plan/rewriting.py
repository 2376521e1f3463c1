"""Paths in plans and rigs: finds them in a file, and writes its text with other paths."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from coupole.errors import InputError
from coupole.plan import yamlfile
from coupole.plan.validation_messages import KeyPath
from coupole.plan.yamlfile import Document

_BLANK = "(a path)"


def named_paths(model: BaseModel) -> Iterator[tuple[KeyPath, Path]]:
    """Yield every path in a plan or a rig, as written, with its key path."""
    yield from _paths(model, ())


def _paths(value: Any, at: KeyPath) -> Iterator[tuple[KeyPath, Path]]:
    if isinstance(value, Path):
        yield at, value
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from _paths(getattr(value, name), (*at, name))
    elif isinstance(value, tuple | list):
        for index, inner in enumerate(value):
            yield from _paths(inner, (*at, index))


def differences(before: BaseModel, now: BaseModel, apart: Set[str] = frozenset()) -> list[str]:
    """Return the keys whose values differ, with both values. Paths count as equal, because the files at the paths
    are compared separately, as are the top-level keys in `apart`."""
    then, here = ({k: v for k, v in _without_paths(model).items() if k not in apart} for model in (before, now))
    return list(_differences(then, here, ""))


def _without_paths(model: BaseModel) -> Any:
    plain = model.model_dump(mode="json")
    for at, _ in named_paths(model):
        *parents, last = at
        part: Any = plain
        for key in parents:
            part = part[key]
        part[last] = _BLANK
    return plain


def _differences(before: Any, now: Any, at: str) -> Iterator[str]:
    if isinstance(before, dict) and isinstance(now, dict) and before.keys() == now.keys():
        for key, value in before.items():
            yield from _differences(value, now[key], f"{at}.{key}" if at else key)
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for index, value in enumerate(before):
            yield from _differences(value, now[index], f"{at}[{index}]")
    elif before != now:
        yield f"{at} was {_short(before)}, is {_short(now)}"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def rewritten(document: Document, text: str, changes: Mapping[KeyPath, str]) -> str:
    """Return the document's `text` with other values at these key paths. A missing key is added at the top level.
    Comments stay if the file's form allows it; otherwise the result is JSON, which is YAML too."""
    new_data = _with_changes(document.data, changes)
    try:
        edited_text = _edited_text(document, text, changes)
        if yamlfile.parse(document.path, edited_text).data == new_data:
            return edited_text
    except (InputError, LookupError):  # an alias, a merged mapping, or a file in braces that lacks a key
        pass
    return json.dumps(new_data, indent=1, ensure_ascii=False) + "\n"


def _with_changes(data: dict[str, Any], changes: Mapping[KeyPath, str]) -> dict[str, Any]:
    changed_data = copy.deepcopy(data)
    for (*parents, last), value in changes.items():
        part: Any = changed_data
        for key in parents:
            part = part[key]
        part[last] = value
    return changed_data


def _edited_text(document: Document, text: str, changes: Mapping[KeyPath, str]) -> str:
    root = yamlfile.compose(document.path, text)
    spans, added_text = [], ""
    for at, value in changes.items():
        if at in document.value_places:
            node = _node(root, at)
            spans.append((node.start_mark.index, node.end_mark.index, json.dumps(value, ensure_ascii=False)))
        elif isinstance(root, MappingNode) and root.flow_style:
            raise LookupError(f"a file written in braces has no key {at[-1]}")
        else:
            added_text += f"{at[-1]}: {json.dumps(value, ensure_ascii=False)}\n"
    for begin, end, value in sorted(spans, reverse=True):
        text = text[:begin] + value + text[end:]
    return text if not added_text else text.rstrip("\n") + "\n" + added_text


def _node(root: Node | None, at: KeyPath) -> ScalarNode:
    """Return the scalar at a key path. Raises LookupError if it is not written there."""
    node = root
    for key in at:
        if isinstance(node, SequenceNode) and isinstance(key, int):
            node = node.value[key]
        elif isinstance(node, MappingNode):
            node = {name.value: value for name, value in node.value}[key]
        else:
            node = None
    if isinstance(node, ScalarNode):
        return node
    raise LookupError(at)
