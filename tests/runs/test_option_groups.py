"""A command that takes a dataclass of options has each of them on its command line."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from coupole.commands.option_groups import flatten_options


@dataclass(frozen=True)
class Box:
    """Sides, one of which has the name that the command's own value has."""

    box: Annotated[int, typer.Option("--width-mm", min=1)] = 3
    height_mm: Annotated[float | None, typer.Option("--height-mm")] = None


@flatten_options
def pack(
    thing: Annotated[str, typer.Argument()],
    count: Annotated[int, typer.Option("--count")] = 1,
    *,
    box: Box,
    wet: Annotated[bool, typer.Option("--wet")] = False,
) -> None:
    print(thing, count, box.box, box.height_mm, wet)


def ended(*words: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(pack)
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.output.strip()


def test_options_of_the_group_stand_where_it_stood() -> None:
    assert list(inspect.signature(pack).parameters) == ["thing", "count", "box", "height_mm", "wet"]


def test_the_command_gets_the_group_with_what_was_given_and_the_defaults() -> None:
    assert ended("vase", "--height-mm", "7.5", "--wet") == (0, "vase 1 3 7.5 True")
    assert ended("vase", "--width-mm", "2", "--count", "4") == (0, "vase 4 2 None False")


def test_limits_of_an_option_in_a_group_hold() -> None:
    code, text = ended("vase", "--width-mm", "0")
    assert code == 2
    assert "--width-mm" in text


def test_python_calls_it_by_the_fields_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    pack("vase", 2, height_mm=1.5)  # type: ignore[call-arg]
    assert capsys.readouterr().out.strip() == "vase 2 3 1.5 False"
