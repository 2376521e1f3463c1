"""Reads YAML files; reports all errors at once, with file:line:column.

`read_document` turns a file into a `Document`: plain data, and the position of each key and value.
`Document.validate` checks a part of it against a pydantic model; its errors become `Problem`s in the order of the
file, with messages from `coupole.plan.validation_messages`.

Typing is YAML 1.2's core schema: `yes` and `on` are text, `014` is fourteen, `0o14` is twelve. Keys are always
text. Models are checked as strictly as JSON would be: `"5"` is not a number, 1.5 and 5.0 are not integers, while
lists are accepted as tuples and text as paths.
"""

from __future__ import annotations

import functools
import json
import math
import pickle
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from coupole.errors import InputError, Problem
from coupole.intake.input_files import InputFiles
from coupole.intake.user_home import with_home
from coupole.plan.validation_messages import KeyPath, Mistake, key_text, mistakes_of
from coupole.plan.yaml_graph import graph

M = TypeVar("M", bound=BaseModel)
Place: TypeAlias = tuple[int, int]
"""Line and column, both from 1."""

MAX_FILE_BYTES = 16 * 1024**2
MAX_DEPTH = 50
MAX_VALUES = 200_000
MAX_DIGITS = 40
"""Limits for plans and rigs. Aliases that multiply each other reach MAX_VALUES."""

_YAML_TAG = "tag:yaml.org,2002:"
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_PLAIN: tuple[tuple[re.Pattern[str], Callable[[str], int | float | bool | None]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda _: None),
    (re.compile(r"true|True|TRUE"), lambda _: True),
    (re.compile(r"false|False|FALSE"), lambda _: False),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text, 8)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text, 16)),
    (_FLOAT, float),
    (re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)
"""Forms of plain scalars in YAML 1.2's core schema (chapter 10.3.2), and the functions that give their values."""


@dataclass(frozen=True)
class Document:
    """One YAML file: its data and the positions of its keys and values."""

    path: Path
    data: dict[str, Any]
    value_places: dict[KeyPath, Place] = field(repr=False)
    key_places: dict[KeyPath, Place] = field(repr=False)
    text: str = field(repr=False)
    """The parsed text, without byte order mark, with LF line ends."""
    _resolved_paths: dict[Path, Path] = field(default_factory=dict, init=False, repr=False, compare=False)

    def resolve(self, path: Path) -> Path:
        """Return `path` made absolute. A relative path is relative to this document's folder. Links are followed
        only once, so that they lead to the same place as long as the document is used."""
        if path not in self._resolved_paths:
            self._resolved_paths[path] = (self.path.parent / with_home(path)).resolve()
        return self._resolved_paths[path]

    def problem(self, key_path: KeyPath, message: str) -> Problem:
        """Return a problem at the value of `key_path`, or at the nearest parent key that exists."""
        if key_path in self.value_places:
            return self._at(self.value_places[key_path], key_path, message)
        parent = key_path
        while parent not in self.value_places:
            parent = parent[:-1]
        return self._at(self.key_places.get(parent, self.value_places[parent]), key_path, message)

    def validate(self, model: type[M], at: KeyPath = ()) -> M:
        """Return the part at key path `at` as a `model`. Raises InputError with every problem."""
        value, problems = self.problems(model, at)
        if value is None:
            raise InputError(problems)
        return value

    def problems(
        self, model: type[M], at: KeyPath = (), *, given_values: dict[str, Any] | None = None
    ) -> tuple[M | None, list[Problem]]:
        """Return the part at key path `at` as a `model`, or None with all problems, in the order of the file.

        A part that is not in the file counts as an empty mapping. `given_values` need not be in the file.
        """
        part = self._part(at)
        if given_values and isinstance(part, dict):
            part = given_values | part
        try:
            return model.model_validate_json(json.dumps(_finite(part)), strict=True), []
        except ValidationError as error:
            problems = [self._mistake(at, mistake) for mistake in mistakes_of(model, part, error)]
        return None, sorted(problems, key=lambda problem: (problem.line, problem.column))

    def _part(self, at: KeyPath) -> Any:
        part: Any = self.data
        for step in at:
            inside = part if isinstance(part, dict) else dict(enumerate(part if isinstance(part, list) else ()))
            if step not in inside:
                return {}
            part = inside[step]
        return part

    def _mistake(self, at: KeyPath, mistake: Mistake) -> Problem:
        """Return the position of the key or the value. For a missing key, it is the position of the mapping or
        list that lacks it."""
        key_path = (*at, *mistake.key_path)
        if mistake.at_key and key_path in self.key_places:
            return self._at(self.key_places[key_path], key_path, mistake.message)
        present = key_path
        while present not in self.value_places:
            present = present[:-1]
        return self._at(self.value_places[present], key_path, mistake.message)

    def _at(self, place: Place, key_path: KeyPath, message: str) -> Problem:
        return Problem(str(self.path), *place, key_text(key_path), message)


def read_document(path: Path, files: InputFiles | None = None) -> Document:
    """Read a YAML file whose root is a mapping.

    Raises InputError for a missing file, text that is not UTF-8, tabs as indentation, wrong YAML syntax, duplicate
    keys, unknown tags, an empty file, or a root that is not a mapping.
    """
    return parse(path, text_of(path, files))


def parse(path: Path, text: str) -> Document:
    """Parse a file's text. `path` is the place of the file, which may be gone."""
    try:
        data, value_places, key_places = pickle.loads(_parsed_bytes(text))
        return Document(path, data, value_places, key_places, text)
    except InputError as error:
        raise InputError([replace(problem, file=str(path)) for problem in error.problems]) from error


@functools.lru_cache(maxsize=64)
def _parsed_bytes(text: str) -> bytes:
    """Return data, and places of values and keys, pickled. One command reads some files several times; a record of
    a calibration takes a second each time. Each caller gets a copy of its own, which it may change. Problems name
    no file."""
    path = Path()
    tabs = [
        Problem(str(path), number, len(line) - len(line.lstrip(" ")) + 1, "", "a tab; indent with spaces")
        for number, line in enumerate(text.split("\n"), start=1)
        if "\t" in line[: len(line) - len(line.lstrip())] and line.strip()
    ]
    if tabs:
        raise InputError(tabs)
    root = compose(path, text)
    if root is None:
        raise InputError([Problem(str(path), 0, 0, "", "the file is empty; expected a mapping of keys to values")])
    builder = _Builder(path)
    data = builder.value(root, ())
    if not isinstance(data, dict):
        builder.complain(root, (), "expected a mapping of keys to values at the top of the file")
    if builder.problems:
        raise InputError(sorted(builder.problems, key=lambda problem: (problem.line, problem.column)))
    return pickle.dumps((data, builder.value_places, builder.key_places))


def text_of(path: Path, files: InputFiles | None = None) -> str:
    """Return the file as text, without byte order mark, with LF line ends. It is read from `files` if these are
    given."""
    files = InputFiles() if files is None else files
    try:
        if path in files:
            return _decoded_text(path, files.read_bytes(path))
        if not path.exists():
            raise InputError([Problem(str(path), 0, 0, "", "no such file")])
        if not path.is_file():
            raise InputError([Problem(str(path), 0, 0, "", "expected a YAML file, found a folder or a device")])
        if (size_bytes := path.stat().st_size) > MAX_FILE_BYTES:
            message = f"{size_bytes} bytes; a YAML file of this kind has {MAX_FILE_BYTES} at most"
            raise InputError([Problem(str(path), 0, 0, "", message)])
        raw = files.read_bytes(path)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise InputError([Problem(str(path), 0, 0, "", f"cannot be read: {error}")]) from error
    return _decoded_text(path, raw)


def _decoded_text(path: Path, raw: bytes) -> str:
    try:
        return raw.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        before = raw[: error.start].decode("utf-8-sig")
        message = f"not UTF-8: byte 0x{raw[error.start]:02x}; save the file as UTF-8"
        raise InputError([_problem_after(path, before, message)]) from error


def compose(path: Path, text: str) -> Node | None:
    """Return the graph of YAML nodes; None if the file has no content."""
    try:
        return graph(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place: Place = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        words = ", ".join(part for part in (error.context, error.problem) if part)
        if error.context_mark and error.context_mark is not error.problem_mark:
            words += f" (begun at line {error.context_mark.line + 1}, column {error.context_mark.column + 1})"
        raise InputError([Problem(str(path), *place, "", f"not valid YAML: {words}")]) from error
    except YAMLError as error:
        before = text[: getattr(error, "position", 0)]
        reason = getattr(error, "reason", str(error))
        raise InputError([_problem_after(path, before, f"not valid YAML: {reason}")]) from error
    except RecursionError as error:
        raise InputError([Problem(str(path), 0, 0, "", f"nested deeper than {MAX_DEPTH} levels")]) from error


def _problem_after(path: Path, before: str, message: str) -> Problem:
    line = before.count("\n") + 1
    return Problem(str(path), line, len(before) - (before.rfind("\n") + 1) + 1, "", message)


def _finite(value: Any) -> Any:
    """Return `value` for JSON. NaN and infinity, which JSON does not have, become text, which no number field
    accepts."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


class _Builder:
    """Builds plain data from YAML nodes, and collects positions and problems."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.value_places: dict[KeyPath, Place] = {}
        self.key_places: dict[KeyPath, Place] = {}
        self.problems: list[Problem] = []

    def complain(self, node: Node, key_path: KeyPath, message: str) -> None:
        problem = Problem(str(self.path), *_place(node), key_text(key_path), message)
        if problem.message not in {p.message for p in self.problems if p.line == problem.line}:  # aliases repeat
            self.problems.append(problem)

    def value(self, node: Node, key_path: KeyPath) -> Any:
        empty = isinstance(node, ScalarNode) and node.start_mark.index == node.end_mark.index
        self.value_places[key_path] = self.key_places.get(key_path, _place(node)) if empty else _place(node)
        if len(key_path) > MAX_DEPTH:
            self.complain(node, key_path[:3], f"nested deeper than {MAX_DEPTH} levels, or an alias within itself")
        elif len(self.value_places) > MAX_VALUES:
            self.complain(node, (), f"more than {MAX_VALUES} values; do aliases multiply each other?")
        elif isinstance(node, MappingNode) and node.tag == _YAML_TAG + "map":
            return {key: self.value(inner, (*key_path, key)) for key, inner in self._entries(node, key_path)}
        elif isinstance(node, SequenceNode) and node.tag == _YAML_TAG + "seq":
            return [self.value(inner, (*key_path, index)) for index, inner in enumerate(node.value)]
        elif isinstance(node, ScalarNode) and str(node.tag).startswith(_YAML_TAG):
            return self._scalar(node, key_path)
        else:
            self.complain(node, key_path, f"YAML tag `{node.tag}` is not known here; leave it out")
        return None

    def _entries(self, node: MappingNode, key_path: KeyPath, depth: int = 0) -> Iterator[tuple[str, Node]]:
        """Yield keys and value nodes. Keys of the mapping itself replace merged ones (`<<`)."""
        own_entries: dict[str, tuple[ScalarNode, Node]] = {}
        merged_nodes: list[Node] = []
        for key_node, value_node in node.value:
            if not isinstance(key_node, ScalarNode):
                self.complain(key_node, key_path, "a key must be text, not a list or a mapping")
            elif key_node.tag == _YAML_TAG + "merge":
                merged_nodes += value_node.value if isinstance(value_node, SequenceNode) else [value_node]
            elif (key := key_node.value) in own_entries:
                first, again = _place(own_entries[key][0]), _place(key_node)
                message = f"duplicate key `{key}`: first given at line {first[0]}, again at line {again[0]}"
                self.complain(key_node, (*key_path, key), message)
            else:
                self._check_text(key_node, key_path)
                own_entries[key] = key_node, value_node
        for key, (key_node, value_node) in own_entries.items():
            self.key_places[(*key_path, key)] = _place(key_node)
            yield key, value_node
        taken_keys = set(own_entries)
        for part in merged_nodes:
            if not isinstance(part, MappingNode) or depth > MAX_DEPTH:
                self.complain(part, key_path, "`<<` merges a mapping or a list of mappings, never itself")
                continue
            for key, value_node in self._entries(part, key_path, depth + 1):
                if key not in taken_keys:
                    taken_keys.add(key)
                    yield key, value_node

    def _scalar(self, node: ScalarNode, key_path: KeyPath) -> str | int | float | bool | None:
        self._check_text(node, key_path)
        text: str = node.value
        if node.style is not None or node.tag == _YAML_TAG + "str":  # quoted, block or plainly text
            return text
        if len(text) > MAX_DIGITS and _FLOAT.fullmatch(text):
            self.complain(node, key_path, f"a number of {len(text)} characters; {MAX_DIGITS} at most")
            return None
        return next((convert(text) for form, convert in _PLAIN if form.fullmatch(text)), text)

    def _check_text(self, node: ScalarNode, key_path: KeyPath) -> None:
        if any("\ud800" <= character <= "\udfff" for character in node.value):
            self.complain(node, key_path, "text with half a surrogate pair is not Unicode text")
        if "\0" in node.value:
            self.complain(node, key_path, "text with a NUL character")


def _place(node: Node) -> Place:
    return node.start_mark.line + 1, node.start_mark.column + 1
