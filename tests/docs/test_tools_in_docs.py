"""Commands of `tools/` that docs, docstrings and the long proofs name: the tool is there, with these options."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPO

sys.path.insert(0, str(REPO / "tools"))

from bench import BENCHES
from full_proofs import PROOFS

DOCS = (REPO / "README.md", *sorted((REPO / "docs").rglob("*.md")))
TOOL = re.compile(r"(?<!\.)(?<!tests/)tools/([a-z_0-9]+(?:\.py)?)(?![\w/.<])")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")


def spans(text: str) -> list[str]:
    """Code of a page: what is in backticks, and the commands of its blocks."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    commands = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [*re.findall(r"`([^`]+)`", prose), *commands]


def named() -> list[tuple[str, str]]:
    """Each command that names a tool, and the place of it."""
    found = [(str(path.relative_to(REPO)), span) for path in DOCS for span in spans(path.read_text())]
    for path in sorted((REPO / "tools").glob("*.py")):
        said = ast.get_docstring(ast.parse(path.read_text())) or ""
        lines = re.sub(r"\n {4,}\[", " [", said).splitlines()
        found += [(f"tools/{path.name}", line) for line in lines if "python tools/" in line]
    found += [(f"the long proof {proof.name}", proof.command) for proof in PROOFS]
    return [(where, " ".join(span.split())) for where, span in found if TOOL.search(span)]


NAMED = named()
COMMANDS = [command for _, command in NAMED]


def options_in(path: Path) -> set[str]:
    """Options of a tool by its source: what `add_argument` is given, or what a shell script has in its text."""
    text = path.read_text()
    if path.suffix != ".py":
        return set(OPTION.findall(text))
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    added = {
        argument.value
        for call in calls
        if isinstance(call.func, ast.Attribute) and call.func.attr == "add_argument"
        for argument in call.args
        if isinstance(argument, ast.Constant)
    }
    if any(isinstance(call.func, ast.Name) and call.func.id == "add_smallest" for call in calls):
        added.add("--smallest")
    return {"--help", *map(str, added)}


def asked(command: str) -> tuple[Path, list[str]]:
    """The tool that a command begins with, and its options."""
    match = TOOL.search(command)
    assert match
    rest = command[match.end() :].partition("#")[0]
    return REPO / "tools" / match.group(1), OPTION.findall(rest)


def test_docs_name_tools() -> None:
    """The search finds them: else nothing below would be tested."""
    tools = {asked(command)[0].name for command in COMMANDS}
    assert {"bench.py", "prove_calibrations.py", "test", "check", "make_kuka_files.py"} <= tools
    assert len(NAMED) > 60
    command = "tools/make_kuka_files.py --output my-cell --pc-address 1  # --remark"
    assert asked(command) == (REPO / "tools/make_kuka_files.py", ["--output", "--pc-address"])


@pytest.mark.parametrize(("where", "command"), NAMED)
def test_a_tool_that_is_named_is_there_with_its_options(where: str, command: str) -> None:
    tool, options = asked(command)
    assert tool.is_file(), f"{where}: there is no {tool.relative_to(REPO)}"
    known = options_in(tool)
    if tool.name == "test" and "--full" in options:
        known |= options_in(REPO / "tools/full_proofs.py")
    if tool.name != "coupole":  # its options are those of the program
        assert known.issuperset(options), f"{where}: {tool.name} has no {sorted(set(options) - known)}"


def test_names_after_a_tool_are_known_to_it() -> None:
    """Benches, long proofs and paths of tests."""
    proofs = {proof.name for proof in PROOFS}
    for where, command in NAMED:
        tool, _ = asked(command)
        rest = command.partition(tool.name)[2].partition("#")[0].split()
        if tool.name == "bench.py" and rest and re.fullmatch(r"[a-z]+", rest[0]):
            assert rest[0] in BENCHES, f"{where}: no bench {rest[0]}"
        if tool.name == "test" and rest[:2] == ["--full", "--only"]:
            assert set(rest[2:]) <= proofs, f"{where}: {command}"
        for path in (word for word in rest if word.startswith("tests/")):
            assert (REPO / path).exists(), f"{where}: there is no {path}"


@pytest.mark.full
@pytest.mark.parametrize(
    "tool",
    sorted({tool for tool, options in map(asked, COMMANDS) if options and tool.suffix == ".py"}),
    ids=lambda tool: tool.name,
)
def test_what_is_named_is_in_the_tools_own_help(tool: Path) -> None:
    wanted = {option for other, options in map(asked, COMMANDS) if other == tool for option in options}
    told = subprocess.run(
        [sys.executable, str(tool), "--help"], capture_output=True, text=True, timeout=120, check=True
    ).stdout
    assert wanted <= set(OPTION.findall(told))
