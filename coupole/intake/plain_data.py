"""JSON, and YAML that is not a plan or rig, as plain data: the one place where others' files and messages are
parsed.

Every text gives data or an InputError with file, line and column. The same is true of text that is not UTF-8,
deeply nested lists, numbers of thousands of digits, NaN, and aliases that multiply each other. Otherwise these
would end in Python's own errors, or much later in a traceback elsewhere. Plans and rigs are read by
`coupole.plan.yamlfile`, which knows the place of each key; pydantic's own reader of JSON has such limits already.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

from coupole.errors import InputError, Problem
from coupole.intake.regular_file import open_regular

MOST_BYTES = 256 * 1024**2
MAX_DEPTH = 100
MAX_DIGITS = 40
"""Greatest number of digits of a whole number; 2^64 has 20."""
MAX_VALUES = 1_000_000
"""Greatest number of values of a YAML text, each alias counted as what it stands for."""

_STRING = re.compile(rb'"(?:[^"\\]|\\.)*"', re.DOTALL)
_OTHER_THAN_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))


class NotDataError(InputError):
    """The text is cut off, or no JSON or YAML at all."""


class _Refused(Exception):
    """A value that JSON's grammar allows, or Python's reader does, and we do not."""

    def __init__(self, token: str, why: str) -> None:
        super().__init__(why)
        self.token = token


def read_json(path: Path, *, allow_nan: bool = False) -> Any:
    """A file's JSON. Raises OSError if the file cannot be read; otherwise the same errors as `json_of`."""
    if (size_bytes := path.stat().st_size) > MOST_BYTES:
        raise InputError(
            [Problem(str(path), 0, 0, "", f"expected at most {MOST_BYTES} bytes, found {size_bytes}")]
        )
    with open_regular(path) as file:
        raw = file.read()
    return json_of(raw, str(path), allow_nan=allow_nan)


def json_of(raw: bytes | str, name: str, *, line: int = 1, allow_nan: bool = False) -> Any:
    """The JSON in a text that begins at this line of the input `name`; a byte order mark is skipped.

    Raises NotDataError if it is no JSON, InputError if a value in it is refused: NaN and infinity unless they are
    allowed, whole numbers of more than MAX_DIGITS digits, more than MAX_DEPTH levels.
    """
    text = _decoded_text(raw, name, line)

    def whole(token: str) -> int:
        if (digits := len(token.removeprefix("-"))) > MAX_DIGITS:
            raise _Refused(token, f"a number of {digits} digits; expected {MAX_DIGITS} at most")
        return int(token)

    def constant(token: str) -> float:
        if not allow_nan:
            raise _Refused(token, f"expected a finite number, found {token}")
        return float(token)

    def finite(token: str) -> float:
        if not math.isfinite(value := float(token)):
            raise _Refused(token, "expected a finite number, found one that is too large")
        return value

    try:
        content = json.loads(
            text, parse_int=whole, parse_constant=constant, parse_float=None if allow_nan else finite
        )
    except json.JSONDecodeError as error:
        raise NotDataError([_problem(text, error.pos, name, line, f"not valid JSON: {error.msg}")]) from error
    except _Refused as error:
        _refuse(text, _place_of(text, error.token), name, line, str(error))
    except RecursionError:
        _refuse(text, _first_too_deep(text), name, line, f"nested deeper than {MAX_DEPTH} levels")
    if _deeper_than_allowed(text):
        _refuse(text, _first_too_deep(text), name, line, f"nested deeper than {MAX_DEPTH} levels")
    return content


def yaml_of(text: str, name: str, *, line: int = 1) -> Any:
    """The YAML in a text, likewise. Raises NotDataError, InputError."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    yaml = YAML(typ="safe", pure=True)
    try:
        root = yaml.compose(text)
        if root is not None and _values(root, {}) > MAX_VALUES:
            raise InputError([Problem(name, line, 1, "", f"aliases that stand for more than {MAX_VALUES} values")])
        return YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at_line, column = (line + mark.line, mark.column + 1) if mark else (line, 1)
        words = ", ".join(part for part in (error.context, error.problem) if part)
        raise NotDataError([Problem(name, at_line, column, "", f"is no YAML: {words}")]) from error
    except RecursionError as error:
        raise InputError([Problem(name, line, 1, "", f"nested deeper than {MAX_DEPTH} levels")]) from error
    except (YAMLError, ValueError, OverflowError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise NotDataError([Problem(name, line, 1, "", f"is not YAML of plain data: {reason}")]) from error


def _values(node: Any, known_counts: dict[int, int]) -> int:
    """Number of values in a node. An alias counts as many values as it stands for; an alias that contains itself
    is too many.
    """
    if id(node) in known_counts:
        return known_counts[id(node)]
    known_counts[id(node)] = MAX_VALUES + 1
    inside = node.value if isinstance(node.value, list) else ()
    count = 1 + sum(
        _values(child, known_counts) for part in inside for child in (part if isinstance(part, tuple) else (part,))
    )
    known_counts[id(node)] = count
    return count


def _decoded_text(raw: bytes | str, name: str, line: int) -> str:
    if isinstance(raw, str):
        return raw.removeprefix("\ufeff")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = raw[: error.start].decode("utf-8-sig", "replace")
        reason = f"not UTF-8: byte 0x{raw[error.start]:02x}"
        raise NotDataError([_problem(before, len(before), name, line, reason)]) from error


def _deeper_than_allowed(text: str) -> bool:
    if text.count("[") + text.count("{") <= MAX_DEPTH:
        return False
    brackets = _STRING.sub(b"", text.encode("utf-8", "surrogatepass")).translate(None, _OTHER_THAN_BRACKETS)
    for _ in range(MAX_DEPTH):  # each turn takes the innermost level away
        brackets = brackets.replace(b"[]", b"").replace(b"{}", b"")
        if not brackets:
            return False
    return True


def _first_too_deep(text: str) -> int:
    """Offset of the first bracket that opens a level too many, outside strings."""
    depth = 0
    for token in re.finditer(r'"(?:[^"\\]|\\.)*"|[\[\]{}]', text, re.DOTALL):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token.group(), 0)
        if depth > MAX_DEPTH:
            return token.start()
    return 0


def _place_of(text: str, token: str) -> int:
    """Offset of the first such token outside strings."""
    for match in re.finditer(rf'"(?:[^"\\]|\\.)*"|(?<![\w.+-]){re.escape(token)}(?![\w.])', text, re.DOTALL):
        if not match.group().startswith('"'):
            return match.start()
    return 0


def _refuse(text: str, at: int, name: str, line: int, message: str) -> NoReturn:
    raise InputError([_problem(text, at, name, line, message)])


def _problem(text: str, at: int, name: str, line: int, message: str) -> Problem:
    before = text[:at]
    return Problem(name, line + before.count("\n"), at - (before.rfind("\n") + 1) + 1, "", message)
