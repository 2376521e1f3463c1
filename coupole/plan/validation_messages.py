"""Messages for the operator from pydantic's errors: one `Mistake` for each mistake.

pydantic reports a flat list of errors whose locations mix keys with labels of unions. `mistakes_of` assigns them
to the nodes of the model's core schema, which has the valid keys, tags, bounds and lengths of each level:

- a tagged union gives only mistakes of the chosen tag, or lists the valid tags;
- a plain union gives one mistake: the mistake of the member with the shape of the value, or a list of everything
  that the union accepts;
- an unknown key that is nearly a valid one is reported instead of the missing key.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, TypeAlias

from pydantic import BaseModel, ValidationError

KeyPath: TypeAlias = tuple[str | int, ...]
Schema: TypeAlias = dict[str, Any]
"""A node of pydantic's core schema."""
Errors: TypeAlias = list[tuple[KeyPath, dict[str, Any]]]
"""pydantic's errors below one node, each with the rest of its location."""

_CONTAINERS = {"model": dict, "tagged-union": dict, "dict": dict, "tuple": list, "list": list, "set": list}
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "text",
    "path": "a path",
}
_PLURALS = {"float": "numbers", "int": "whole numbers", "str": "texts", "path": "paths"}
_BOUNDS = (
    ("gt", "above"),
    ("ge", "at least"),
    ("lt", "below"),
    ("le", "at most"),
    ("multiple_of", "a multiple of"),
)


@dataclass(frozen=True)
class Mistake:
    """One mistake: its key path below the checked part, and its message."""

    key_path: KeyPath
    message: str
    at_key: bool = False
    """True if it concerns the key itself, not its value."""


def key_text(key_path: KeyPath) -> str:
    """Return `("views", 2, "distance_mm")` as `views[2].distance_mm`."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in key_path)
    return text.removeprefix(".")


def mistakes_of(model: type[BaseModel], value: Any, error: ValidationError) -> list[Mistake]:
    """Return the mistakes in `value` that made `model` raise `error`."""
    errors: Errors = [(tuple(item["loc"]), dict(item)) for item in error.errors(include_url=False)]
    return list(_Explainer(dict(model.__pydantic_core_schema__)).mistakes((), value, errors))


def did_you_mean(word: str, valid: Iterable[str]) -> str | None:
    """Return the valid word nearest to a misspelt one, if there is one that is near."""
    by_folded = {name.casefold(): name for name in valid}
    folded_word = word.casefold()
    near = difflib.get_close_matches(folded_word, by_folded, n=1, cutoff=0.6)
    longer_words = [name for name in by_folded if len(folded_word) >= 3 and name.startswith(folded_word)]
    return by_folded[(longer_words or near)[0]] if longer_words or near else None


class _Explainer:
    def __init__(self, schema: Schema, definitions: dict[str, Schema] | None = None) -> None:
        self.definitions = definitions or {item["ref"]: item for item in schema.get("definitions", ())}
        self.node = self._peel(schema)
        self.kind: str = self.node["type"]

    def _peel(self, node: Schema) -> Schema:
        """Return the schema's node inside all validators, defaults and references around it."""
        while True:
            if node["type"] == "definition-ref":
                node = self.definitions[node["schema_ref"]]
            elif node["type"] == "lax-or-strict":
                node = node["strict_schema"]
            elif node["type"] == "json-or-python":
                python = node["python_schema"]
                is_path = python["type"] == "is-instance" and issubclass(python["cls"], PurePath)
                node = {"type": "path"} if is_path else node["json_schema"]
            elif "schema" in node and (node["type"] != "model" or node.get("root_model")):
                node = node["schema"]
            else:
                return node

    def _inner(self, schema: Schema) -> _Explainer:
        return _Explainer(schema, self.definitions)

    # ---- mistakes ----

    def mistakes(self, path: KeyPath, value: Any, errors: Errors) -> Iterator[Mistake]:
        """Yield the mistakes of `value`, which is at `path` and has this node's schema."""
        own_errors = [error for rest, error in errors if not rest]
        below: dict[str | int, Errors] = {}
        for rest, error in errors:
            if rest:
                below.setdefault(rest[0], []).append((rest[1:], error))
        if self.kind == "union" and below:
            yield from self._union(path, value, list(below.values()))
        elif self.kind == "tagged-union" and isinstance(value, dict):
            yield from self._tagged_union(path, value, own_errors, below)
        elif self.kind == "model" and isinstance(value, dict):
            yield from self._model(path, value, own_errors, below)
        elif self.kind in ("tuple", "list", "set") and isinstance(value, list):
            yield from self._list(path, value, own_errors, below)
        elif self.kind == "dict" and isinstance(value, dict):
            yield from self._own_mistake(path, value, own_errors)
            for key, inner in below.items():
                yield from self._inner(self.node["values_schema"]).mistakes((*path, key), value.get(key), inner)
        else:
            yield from self._own_mistake(path, value, own_errors or [error for _, error in errors])

    def _own_mistake(self, path: KeyPath, value: Any, own_errors: list[dict[str, Any]]) -> Iterator[Mistake]:
        """Yield the first error of the value itself: a validator's message, or the expected and the found
        value."""
        for error in own_errors[:1]:
            if error["type"] in ("value_error", "assertion_error"):
                yield Mistake(path, str(error["ctx"]["error"]))
            elif self.kind in _WORDS or self.kind in _CONTAINERS or self.kind in ("literal", "enum", "union"):
                yield Mistake(path, f"expected {self.words()}, found {found_text(value)}{self._hint(value)}")
            else:
                yield Mistake(path, f"{error['msg']}; found {found_text(value)}")

    def _hint(self, value: Any) -> str:
        choices = [item for item in self._literals() if isinstance(item, str)]
        near = did_you_mean(value, choices) if isinstance(value, str) else None
        return f"; did you mean `{near}`?" if near else ""

    def _union(self, path: KeyPath, value: Any, by_member: list[Errors]) -> Iterator[Mistake]:
        """Yield mistakes when all members of a plain union failed: the mistakes of the member that has the value's
        shape."""
        members = [self._inner(choice) for choice in self._choices()]
        if len(members) == len(by_member):
            for member, errors in zip(members, by_member, strict=True):
                if isinstance(value, _CONTAINERS.get(member.kind, ())):
                    yield from member.mistakes(path, value, errors)
                    return
        yield from self._own_mistake(path, value, [{"type": "union", "msg": ""}])

    def _tagged_union(
        self, path: KeyPath, value: dict[str, Any], own_errors: list[Any], below: Any
    ) -> Iterator[Mistake]:
        for tag, errors in below.items():
            yield from self._inner(self.node["choices"][tag]).mistakes(path, value, errors)
        if own_errors and (key := self.node["discriminator"]) in value:
            tag, tags = value[key], [str(item) for item in self.node["choices"]]
            near = did_you_mean(tag, tags) if isinstance(tag, str) else None
            hint = f"; did you mean `{near}`?" if near else ""
            yield Mistake((*path, key), f"expected one of {_quoted_list(tags)}, found {found_text(tag)}{hint}")
        elif own_errors:
            known_keys = {
                name for choice in self.node["choices"].values() for name in self._inner(choice).fields()
            }
            near = did_you_mean(key, [name for name in value if name not in known_keys])
            tags_text = f"one of {_quoted_list(self.node['choices'])}"
            if near:
                yield Mistake(
                    (*path, near), f"unknown key `{near}`; did you mean `{key}`, {tags_text}?", at_key=True
                )
            else:
                yield Mistake((*path, key), f"missing key `{key}`: {tags_text}")

    def _model(self, path: KeyPath, value: dict[str, Any], own_errors: list[Any], below: Any) -> Iterator[Mistake]:
        yield from self._own_mistake(path, value, own_errors)
        fields = self.fields()
        missing = [key for key, errors in below.items() if _only(errors) == "missing"]
        unknown = [key for key, errors in below.items() if _only(errors) == "extra_forbidden"]
        for key in unknown:
            near = did_you_mean(key, missing) or did_you_mean(key, [name for name in fields if name not in value])
            if near in missing:
                missing.remove(near)
            hint = f"did you mean `{near}`? " if near else ""
            message = f"unknown key `{key}`; {hint}valid keys: {', '.join(fields)}"
            yield Mistake((*path, key), message, at_key=True)
        for key in missing:
            yield Mistake((*path, key), f"missing key `{key}`: {self._inner(fields[key]).words()}")
        for key, errors in below.items():
            if _only(errors) not in ("missing", "extra_forbidden"):
                yield from self._inner(fields[key]).mistakes((*path, key), value.get(key), errors)

    def _list(self, path: KeyPath, value: list[Any], own_errors: list[Any], below: Any) -> Iterator[Mistake]:
        # pydantic also reports a list with failed items as too short, because it does not count these.
        fits = self.node.get("min_length", 0) <= len(value) <= self.node.get("max_length", math.inf)
        lengths = [error for error in own_errors if error["type"] in ("too_short", "too_long")]
        absent = [index for index, errors in below.items() if _only(errors) == "missing" and index >= len(value)]
        if absent or (lengths and not (fits and self._variable())):
            yield Mistake(path, f"expected {self.words()}, found {len(value)}")
        yield from self._own_mistake(path, value, [error for error in own_errors if error not in lengths])
        for index, errors in below.items():
            if index not in absent:
                yield from self._inner(self._item(int(index))).mistakes((*path, index), value[int(index)], errors)

    # ---- what the schema says ----

    def fields(self) -> dict[str, Schema]:
        """Schemas of a model's keys, by key."""
        fields = self.node["schema"] if self.kind == "model" else {}
        while fields and "fields" not in fields:
            fields = fields["schema"]
        items = fields.get("fields", {}).items()
        return {str(item.get("validation_alias", name)): item["schema"] for name, item in items}

    def _choices(self) -> list[Schema]:
        return [choice[0] if isinstance(choice, tuple) else choice for choice in self.node["choices"]]

    def _literals(self) -> list[Any]:
        if self.kind == "union":
            return [item for choice in self._choices() for item in self._inner(choice)._literals()]
        if self.kind == "enum":
            return [member.value for member in self.node["members"]]
        return list(self.node["expected"]) if self.kind == "literal" else []

    def _variable(self) -> bool:
        return self.kind != "tuple" or "variadic_item_index" in self.node

    def _item(self, index: int) -> Schema:
        items = self.node.get("items_schema", {"type": "any"})
        if self.kind != "tuple":
            return dict(items)
        return dict(items[0] if self._variable() else items[index])

    def words(self) -> str:
        """Describe what this node accepts, as `a number from 0 to 42`."""
        if self.kind in ("literal", "enum"):
            return " or ".join(f"`{item}`" for item in self._literals())
        if self.kind == "union":
            return " or ".join(self._inner(choice).words() for choice in self._choices())
        if self.kind == "tagged-union":
            return f"a mapping whose `{self.node['discriminator']}` is one of {_quoted_list(self.node['choices'])}"
        if self.kind in ("tuple", "list", "set"):
            return self._list_words()
        if self.kind == "str" and "pattern" in self.node:
            return f"text of the form {self.node['pattern']}"
        return self._bounded_words()

    def _bounded_words(self) -> str:
        words = _WORDS.get(self.kind, "a mapping" if self.kind in _CONTAINERS else "a value")
        least, most = self.node.get("ge"), self.node.get("le")
        if least is not None and most is not None:
            return f"{words} from {least:.12g} to {most:.12g}"
        bounds = [f"{word} {self.node[key]:.12g}" for key, word in _BOUNDS if self.node.get(key) is not None]
        return " ".join([words, " and ".join(bounds)]) if bounds else words

    def _list_words(self) -> str:
        item = self._inner(self._item(0))
        plural = _PLURALS.get(item.kind, "values" if item.kind not in _CONTAINERS else "entries")
        if not self._variable():
            return f"a list of {len(self.node['items_schema'])} {plural}"
        least, most = self.node.get("min_length"), self.node.get("max_length")
        counts = [f"at least {least}"] * bool(least) + [f"at most {most}"] * (most is not None)
        return f"a list of {plural}" + (f" ({' and '.join(counts)})" if counts else "")


def found_text(value: Any) -> str:
    """Return a value in a form that the operator recognises."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"text `{value if len(value) <= 60 else value[:57] + '...'}`"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "a mapping"
    return f"{value}, no finite number" if isinstance(value, float) and not math.isfinite(value) else f"{value}"


def _quoted_list(words: Iterable[Any]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def _only(errors: Errors) -> str:
    """Return the type of the error of the key itself; empty if the errors are deeper."""
    return str(errors[0][1]["type"]) if not errors[0][0] else ""
