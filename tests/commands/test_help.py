"""The list of commands has headings, and each command's help ends with two examples that the real parser takes."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
import typer
from typer.core import TyperGroup

from coupole.commands.cli import COMMANDS, GROUPS, app
from coupole.commands.examples import EXAMPLES, HEADING


def steps(command: Any, name: str) -> Iterator[str]:
    """Names of a command and of its steps."""
    yield name
    for step in getattr(command, "commands", {}).values():
        yield from steps(step, f"{name} {step.name}")


def parsed(line: str) -> str:
    """Parse a command line as far as the call of its function; the name of the command."""
    command: Any = typer.main.get_command(app)
    context = command.make_context("coupole", shlex.split(line))
    words = []
    while isinstance(command, TyperGroup):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert command is not None
        words.append(str(name))
        context = command.make_context(name, rest, parent=context)
    return " ".join(words)


ALL = [name for top in COMMANDS for name in steps(typer.main.get_command(app).commands[top], top)]  # type: ignore[attr-defined]


def test_help_lists_every_command_under_its_heading() -> None:
    shown = cells.here("--help").out
    places = [shown.index(f"─ {heading} ─") for heading in GROUPS]
    assert places == sorted(places)
    for place, end, group in zip(places, [*places[1:], len(shown)], GROUPS.values(), strict=True):
        lines = shown[place:end].splitlines()
        assert [name for name in COMMANDS if any(line.startswith(f"│ {name} ") for line in lines)] == list(group)


def test_each_command_and_step_has_examples() -> None:
    assert sorted(EXAMPLES) == sorted(ALL)


@pytest.mark.parametrize("name", ALL)
def test_the_parser_takes_the_examples_of_a_command(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    of_its_own = name.removesuffix(" from")  # the step that nobody types
    for example in EXAMPLES[name]:
        assert (parsed(example) + " ").startswith(f"{of_its_own} "), example


QUICK = ("plan new", "schema", "check", "view", "simulate", "devices", "dose")
"""Commands whose examples are run: they need no file but that of `plan new first`."""


@pytest.mark.parametrize(
    "example",
    [
        one
        for name in QUICK
        for one in EXAMPLES[name]
        if not {"my-cell.yaml", "leds", "12", "--show", "--add"} & set(shlex.split(one))
    ],
)
def test_an_example_that_needs_no_device_of_ones_own_runs(
    example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if "first.yaml" in example:
        assert cells.here(*shlex.split(EXAMPLES["plan new"][0])).code == 0
    ended = cells.here(*shlex.split(example))
    assert ended.code == 0, ended.err


@pytest.mark.parametrize("line", ["check first.yaml --no-path", "verify", "arm sim home x y z", "plan neu first"])
def test_the_parser_refuses_what_is_no_command(line: str) -> None:
    with pytest.raises(Exception, match=r"No such|Missing|unexpected") as refused:
        parsed(line)
    assert hasattr(refused.value, "exit_code")


@pytest.mark.parametrize("name", ["check", "calibrate camera", "reflectance"])
def test_help_ends_with_the_examples(name: str) -> None:
    shown = cells.here(*name.split(), "--help").out
    lines = [line.strip() for line in shown.partition(HEADING)[2].splitlines() if line.strip()]
    assert lines == [f"coupole {example}" for example in EXAMPLES[name]]
