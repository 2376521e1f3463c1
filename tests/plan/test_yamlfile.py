"""Reading YAML with places: what is typed how, what is refused where, before any model is asked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from coupole.errors import InputError
from coupole.plan.yamlfile import Document, read_document


class Port(BaseModel):
    """What a driver might ask of its settings; laxer than our own models."""

    port: str
    baud: int = 9600
    scale: float = 1.0
    tags: dict[str, float] = {}


def document(folder: Path, text: str | bytes) -> Document:
    path = folder / "some.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_document(path)


def refusal(folder: Path, text: str | bytes) -> list[str]:
    with pytest.raises(InputError) as refused:
        document(folder, text)
    return [str(problem).removeprefix(str(folder) + "/") for problem in refused.value.problems]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-7", -7),
        ("014", 14),
        ("0o14", 12),
        ("0x1F", 31),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("true", True),
        ("FALSE", False),
        ("yes", "yes"),
        ("off", "off"),
        ("1_000", "1_000"),
        ("12:30:00", "12:30:00"),
        ("2020-01-01", "2020-01-01"),
        ("'5'", "5"),
        ("!!str 5", "5"),
        ("", None),
        ("~", None),
        ("[1, {b: c}]", [1, {"b": "c"}]),
        ("|\n  two\n  lines\n", "two\nlines\n"),
    ],
)
def test_scalars_have_the_types_of_yaml_1_2(tmp_path: Path, text: str, value: Any) -> None:
    found = document(tmp_path, f"a: {text}").data["a"]
    assert found == value
    assert type(found) is type(value)


def test_keys_are_always_text(tmp_path: Path) -> None:
    assert list(document(tmp_path, "12: a\nyes: b\nnull: c\n").data) == ["12", "yes", "null"]


def test_anchors_aliases_and_merges_are_followed(tmp_path: Path) -> None:
    text = "base: &base {x: 1, y: 2}\nuse:\n  <<: *base\n  y: 3\nagain: *base\n"
    assert document(tmp_path, text).data["use"] == {"y": 3, "x": 1}
    assert document(tmp_path, text).data["again"] == {"x": 1, "y": 2}


def test_a_later_anchor_takes_the_place_of_one_of_the_same_name(tmp_path: Path) -> None:
    assert document(tmp_path, "first: &a 1\nsecond: &a 2\nthird: *a\n").data["third"] == 2


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "some.yaml: the file is empty; expected a mapping of keys to values"),
        ("# only a remark\n", "some.yaml: the file is empty; expected a mapping of keys to values"),
        ("- a\n- b\n", "some.yaml:1:1: expected a mapping of keys to values at the top of the file"),
        ("just words", "some.yaml:1:1: expected a mapping of keys to values at the top of the file"),
        ("a:\n\tb: 1\n", "some.yaml:2:1: a tab; indent with spaces"),
        ("a:\n  b: 1\n  \tc: 1\n", "some.yaml:3:3: a tab; indent with spaces"),
        ("a: b: c\n", "some.yaml:1:5: not valid YAML: mapping values are not allowed here"),
        ("a: *gone\n", "some.yaml:1:4: not valid YAML: found undefined alias 'gone'"),
        (b"a: 1\nb: caf\xe9\n", "some.yaml:2:7: not UTF-8: byte 0xe9; save the file as UTF-8"),
        ("a: 1\nb: \x07\n", "some.yaml:2:4: not valid YAML: special characters are not allowed"),
        ("a: 1\nb: 2\na: 3\n", "some.yaml:3:1: a: duplicate key `a`: first given at line 1, again at line 3"),
        (
            "a: !python/object:os.system x\n",
            "some.yaml:1:4: a: YAML tag `!python/object:os.system` is not known",
        ),
        ("a: &loop [*loop]\n", "an alias within itself"),
        ("a: &loop {<<: *loop}\n", "never itself"),
        ("[a, b]: 1\n", "some.yaml:1:1: a key must be text, not a list or a mapping"),
        ("a: " + "9" * 5000, "some.yaml:1:4: a: a number of 5000 characters"),
        ('a: "\\ud800"\n', "some.yaml:1:4: a: text with half a surrogate pair"),
        ("a: " + "[" * 60 + "]" * 60, "nested deeper than 50 levels"),
        ("a: " + "[" * 1000, "nested deeper than 50 levels"),
        ("a: 1\n---\nb: 2\n", "some.yaml:2:1: not valid YAML: expected a single document in the stream"),
    ],
)
def test_what_is_no_mapping_in_yaml_is_refused_with_its_place(
    tmp_path: Path, text: str | bytes, problem: str
) -> None:
    assert problem in refusal(tmp_path, text)[0]


def test_an_unclosed_bracket_names_both_its_end_and_its_beginning(tmp_path: Path) -> None:
    (problem,) = refusal(tmp_path, "a: 1\nb: [1, 2\nc: 3\n")
    assert problem.startswith("some.yaml:3:2: not valid YAML")
    assert "begun at line 2, column 4" in problem


def test_all_duplicate_keys_are_reported_in_the_order_of_the_file(tmp_path: Path) -> None:
    problems = refusal(tmp_path, "a: 1\nb: {c: 1, c: 2}\na: 2\na: 3\n")
    places = [problem.split(": ")[0] for problem in problems]
    assert places == ["some.yaml:2:11", "some.yaml:3:1", "some.yaml:4:1"]


def test_aliases_that_multiply_each_other_are_refused(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 8)}]" for n in range(1, 12)]
    assert "do aliases multiply each other?" in refusal(tmp_path, "\n".join(lines))[0]


@pytest.mark.parametrize("name", ["gone.yaml", "."])
def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"no such file|found a folder"):
        read_document(tmp_path / name)


def test_a_byte_order_mark_and_windows_line_ends_do_not_shift_places(tmp_path: Path) -> None:
    found = document(tmp_path, b"\xef\xbb\xbfa: 1\r\nb:\r\n  c: 2\r\n")
    assert found.data == {"a": 1, "b": {"c": 2}}
    assert found.problem(("b", "c"), "wrong").column == 6


def test_a_problem_stands_at_its_value_or_at_the_nearest_parent_key(tmp_path: Path) -> None:
    found = document(tmp_path, "a: 1\nb:\n  - c: 2\n    d:\n      e: 3\n")
    assert str(found.problem(("b", 0, "d", "e"), "wrong")).endswith("some.yaml:5:10: b[0].d.e: wrong")
    assert str(found.problem(("b", 0, "d", "f", 1), "wrong")).endswith("some.yaml:4:5: b[0].d.f[1]: wrong")
    assert str(found.problem(("z",), "wrong")).endswith("some.yaml:1:1: z: wrong")


def test_an_empty_value_stands_at_its_key(tmp_path: Path) -> None:
    problem = document(tmp_path, "a: 1\n\nb:\n\nc: 2\n").problem(("b",), "wrong")
    assert (problem.line, problem.column) == (3, 1)


def test_a_part_is_validated_with_the_key_path_of_the_whole(tmp_path: Path) -> None:
    found = document(tmp_path, "box:\n  settings: {prt: x, baud: '9600', scale: .nan, tags: {a: b}}\n")
    _, problems = found.problems(Port, ("box", "settings"))
    assert [problem.key for problem in problems] == [
        "box.settings.port",
        "box.settings.baud",
        "box.settings.scale",
        "box.settings.tags.a",
    ]


def test_a_part_that_is_not_in_the_file_counts_as_empty(tmp_path: Path) -> None:
    value, problems = document(tmp_path, "box: {}\n").problems(Port, ("box", "settings"))
    assert value is None
    assert [str(p).split("some.yaml:")[1] for p in problems] == [
        "1:6: box.settings.port: missing key `port`: text"
    ]


def test_a_valid_part_becomes_the_model(tmp_path: Path) -> None:
    found = document(tmp_path, "box: {settings: {port: COM3, scale: 2}}\n")
    assert found.validate(Port, ("box", "settings")) == Port(port="COM3", scale=2.0)


def test_paths_are_resolved_from_the_folder_of_the_document(tmp_path: Path) -> None:
    found = document(tmp_path, "a: 1")
    assert found.resolve(Path("../b.yaml")) == tmp_path.parent / "b.yaml"
    assert found.resolve(Path("/c.yaml")) == Path("/c.yaml")


@given(st.text(alphabet=" \n:-[]{},&*!|>'\"%@`#?~<ab01.\t\u00e9", max_size=60))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    try:
        accepted: Any = document(tmp_path_factory.getbasetemp(), text).data
    except InputError as error:
        accepted = {} if error.problems else None
    assert isinstance(accepted, dict)
