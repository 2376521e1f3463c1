"""What the reader of JSON and YAML makes of texts that others wrote: data, or an error with its place."""

from __future__ import annotations

import contextlib
import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import REPO

from coupole.errors import InputError
from coupole.intake.plain_data import MAX_DEPTH, NotDataError, json_of, read_json, yaml_of

BOMB = "a0: &a0 [1, 2]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 30))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a":\n  ' + "9" * 5000 + "}", "f:8:3: a number of 5000 digits"),
        ('["' + "1" * 50 + '", ' + "1" * 50 + "]", "f:7:56: a number of 50 digits"),
        ("[" * 100_000, f"f:7:{MAX_DEPTH + 1}: nested deeper"),
        ("[" * 101 + "]" * 101, f"f:7:{MAX_DEPTH + 1}: nested deeper"),
        ('{"[[": ' + '{"a":' * 5000 + "1" + "}" * 5001, f"f:7:{7 + 5 * (MAX_DEPTH - 1) + 1}: nested deeper"),
        ('{"a": NaN}', "f:7:7: expected a finite number, found NaN"),
        ("[-Infinity]", "f:7:2: expected a finite number, found -Infinity"),
        ("[1e999]", "f:7:2: expected a finite number"),
        (b'{"a":\n "\xff"}', "f:8:3: not UTF-8: byte 0xff"),
        ('{"a": ', "f:7:7: not valid JSON"),
        ("", "f:7:1: not valid JSON"),
    ],
)
def test_json_that_is_refused_names_file_line_and_column(text: str | bytes, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        json_of(text, "f", line=7)


def test_a_byte_order_mark_and_the_deepest_that_is_allowed_are_read() -> None:
    assert json_of(b'\xef\xbb\xbf{"a": 1}', "f") == {"a": 1}
    assert json_of("[" * MAX_DEPTH + "]" * MAX_DEPTH, "f")
    assert math.isnan(json_of("NaN", "f", allow_nan=True))


PLAIN = st.none() | st.booleans() | st.integers(-(10**39), 10**39) | st.text()


@given(st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_what_json_writes_is_read_as_it_was(value: object) -> None:
    assert json_of(json.dumps(value), "f") == value


@given(st.binary() | st.text('[]{}",:0123456789.eE+-NaIfity \\\n'))
def test_anything_is_data_or_an_error_of_ours(raw: bytes | str) -> None:
    text = raw if isinstance(raw, str) else raw.decode("latin-1")
    with contextlib.suppress(InputError):
        json_of(raw, "f")
    with contextlib.suppress(InputError):
        yaml_of(text, "f")


HOSTILE = ["[" * 10_000, "[" * 10_000 + "]" * 10_000, BOMB, "a: " + "9" * 5000, "a: &x [*x]", "a: !!python/x 1"]


@pytest.mark.parametrize("text", [*HOSTILE, "a: 2024-99-99"])
def test_yaml_that_is_refused_is_an_error_of_ours(text: str) -> None:
    with pytest.raises(InputError):
        yaml_of(text, "f")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(300 * 1024**2)
    with pytest.raises(InputError, match="expected at most"):
        read_json(path)


def test_text_that_is_cut_off_is_told_apart_from_what_is_refused() -> None:
    with pytest.raises(NotDataError):
        json_of('{"event": "fra', "f")
    with pytest.raises(InputError) as refused:
        json_of("9" * 5000, "f")
    assert not isinstance(refused.value, NotDataError)


PARSES = re.compile(r"\bjson\.loads?\(|\bYAML\(|\byaml\.(?:safe_)?load\(")
OWN_WORDS = re.compile(r"json\.loads\(\w+\.model_dump_json\(|json\.loads\(json\.dumps\(")
"""Not of a file: what the program itself has just written."""
READERS = {
    "coupole/intake/plain_data.py",
    "coupole/plan/yaml_graph.py",
    # write YAML anew with its comments, from a text that yamlfile has read
    "coupole/commands/simulated_support.py",
    "coupole/console/plans/plan_fields.py",
    "coupole/preflight/exposure_advice.py",
    "coupole/appearance/matter/paint_file.py",
    # write the YAML of a model
    "coupole/heritage/restoration/scene_of_hypothesis.py",
    "coupole/scripting/plans.py",
}


def test_no_module_parses_json_or_yaml_by_itself() -> None:
    found = [
        f"{path.relative_to(REPO)}:{number}: {line.strip()}"
        for path in sorted((REPO / "coupole").rglob("*.py"))
        if str(path.relative_to(REPO)) not in READERS
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if PARSES.search(line) and not OWN_WORDS.search(line)
    ]
    assert not found, "use coupole.intake.plain_data:\n" + "\n".join(found)
