"""The quick way to a YAML text's graph gives what ruamel.yaml gives, or nothing."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import REPO
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode

from coupole.plan import yaml_graph
from coupole.plan.yaml_graph import composed_by_ruamel, graph

PIECES = (
    *(
        "a",
        "b c",
        "1",
        "1.5",
        "0o14",
        "0x1F",
        "014",
        "true",
        "yes",
        "on",
        "~",
        "null",
        "1e5",
        ".5",
        ".inf",
        "12:30",
    ),
    *(
        "2020-01-01",
        "x:y",
        "x: y",
        "=",
        "<<",
        "<<: ",
        " ",
        "  ",
        "\n",
        "\n  ",
        "\n    ",
        "\n- ",
        "- ",
        ": ",
        ":",
        "a: ",
    ),
    *(
        "k:",
        "{",
        "}",
        "[",
        "]",
        ", ",
        ",",
        '"x"',
        "'y'",
        '"',
        "'",
        "#",
        " # c",
        "-",
        "--",
        '"a": 1',
        "{a: 1}",
        "[1, 2]",
    ),
    *("?", "|", ">", "&a ", "*a", "!t ", "%", "@", "`", "\\", "\t", "\u00e9", "\n---\n", "\n...\n"),
)
SHIPPED = sorted(REPO.glob("configs/**/*.yaml"))


def parts(node: Any) -> Any:
    """Everything of a graph that its readers ask for."""
    marks = [(mark.index, mark.line, mark.column) for mark in (node.start_mark, node.end_mark)]
    if isinstance(node, ScalarNode):
        return str(node.tag), node.value, node.style, marks
    inner = node.value if not isinstance(node, MappingNode) else [one for pair in node.value for one in pair]
    return str(node.tag), type(node), node.flow_style, [parts(one) for one in inner], marks


def assert_alike(text: str) -> bool:
    """Whether there was a quick way."""
    quick = yaml_graph._composed_quickly(text)
    if quick is None:
        return False
    try:
        slow = composed_by_ruamel(text)
    except YAMLError as error:
        raise AssertionError(f"ruamel refuses {text!r}") from error
    assert parts(quick) == parts(slow)
    return True


@settings(max_examples=500)
@given(pieces=st.lists(st.sampled_from(PIECES), max_size=14), ends=st.sampled_from(["", "\n"]))
def test_any_text_has_the_graph_that_ruamel_gives_it(pieces: list[str], ends: str) -> None:
    assert_alike("".join(pieces) + ends)


@given(
    data=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
        max_leaves=20,
    ),
    indent=st.sampled_from([None, 1]),
)
def test_any_json_has_the_graph_that_ruamel_gives_it(data: Any, indent: int | None) -> None:
    assert_alike(json.dumps(data, indent=indent))


def test_most_files_that_are_shipped_take_the_quick_way() -> None:
    quick = [path for path in SHIPPED if assert_alike(path.read_text())]
    assert len(quick) > 0.6 * len(SHIPPED)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "{a: " * 100_000, "- " * 100_000, "".join(f"{n * ' '}a:\n" for n in range(5000))]
)
def test_a_text_that_nests_deeply_does_not_overflow_the_stack(text: str) -> None:
    with pytest.raises((YAMLError, RecursionError)):
        graph(text + "\n")
