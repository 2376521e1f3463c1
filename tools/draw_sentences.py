"""Draws sentences of the project by seed, for a reader who counts those that need a second reading.

    python tools/draw_sentences.py --of docs|messages|docstrings [--seed N] [--number 40] [PATH ...]

- *docs*: README, the pages of `docs/` and the text of the notebooks: paragraphs, lists, cells of tables.
- *messages*: help of commands and options, and strings of at least five words in `coupole`, `drivers` and `sim`.
- *docstrings*: those of `coupole`, `drivers` and `sim` that are not the help of a command.

With PATH, only files below it are used (relative to the project). Each sentence is equally likely, and is drawn at
most once. `docs/reference/plain-english.md` has the rules and the counts.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ("coupole", "drivers", "sim")
FEWEST_WORDS = 5
QUOTES = "plain-english.md"
"""Page that quotes sentences which need a second reading; nothing is drawn from it."""
_END = re.compile(r"(?<=[.!?])[)\"'*_`]*\s+(?=[\"'(*_`{\[]*[A-Z0-9`{-])")
_ABBREVIATION = re.compile(r"(\b(e\.g|i\.e|vs|cf|Fig|No|approx|Dr|et al)|\b[A-Z])\.$")
_MARKUP = re.compile(r"</|/>|[{};]\n|\bfunction\b")
"""Signs of HTML, styles and scripts in a string."""
_COMMAND_MARKS = ("typer.Option", "typer.Argument", "Annotated[")


@dataclass(frozen=True)
class Sentence:
    """One sentence, and where its paragraph begins."""

    place: str
    """File and line."""
    text: str


def sentences(paragraph: str) -> list[str]:
    """Return the sentences of one paragraph; those of fewer than five words are left out."""
    whole: list[str] = []
    for part in _END.split(" ".join(paragraph.split())):
        if whole and _ABBREVIATION.search(whole[-1]):
            whole[-1] += " " + part
        else:
            whole.append(part)
    return [sentence for sentence in whole if len(_plain_words(sentence)) >= FEWEST_WORDS]


def paragraphs_of_page(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, items of lists and cells of tables of a page, with their lines; no headings, no code."""
    heading = False
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        heading = token.type == "heading_open" or (heading and token.type != "heading_close")
        if token.type == "inline" and not heading:
            yield (token.map or [0])[0] + 1, _shown(token.children or [])


def paragraphs_of_notebook(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs of the Markdown cells of a notebook in py:percent, with their lines."""
    for cell in re.finditer(r"^# %% \[markdown\]\n((?:#(?! %%).*\n)*)", text, re.MULTILINE):
        first = text.count("\n", 0, cell.start(1))
        for line, paragraph in paragraphs_of_page(re.sub(r"^# ?", "", cell[1], flags=re.MULTILINE)):
            yield first + line, paragraph


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Docstrings that are not the help of a command, with their lines."""
    for node, text, line in _all_docstrings(ast.parse(source)):
        if not _is_command(node, source):
            yield from _paragraphs(text, line)


def messages(source: str) -> Iterator[tuple[int, str]]:
    """Help of commands, and all strings that are no docstrings, with their lines; values are shown as `{...}`."""
    tree = ast.parse(source)
    docs = set()
    for node, text, line in _all_docstrings(tree):
        docs.add(line)
        if _is_command(node, source):
            yield from _paragraphs(text, line)
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    for node in ast.walk(tree):
        match node:
            case ast.JoinedStr():
                yield from _paragraphs(_with_values(node), node.lineno)
            case ast.Constant(str(text)) if id(node) not in inside and node.lineno not in docs:
                yield from _paragraphs(text, node.lineno)
            case _:
                pass


def all_sentences(kind: str, below: list[str] | None = None) -> list[Sentence]:
    """Return every sentence of `docs`, `messages` or `docstrings` in the order of files, without doubles."""
    by_text: dict[str, Sentence] = {}
    for path, paragraphs in _files(kind):
        name = path.relative_to(ROOT)
        if below and not any(name.is_relative_to(place) for place in below):
            continue
        for line, paragraph in paragraphs(path.read_text(encoding="utf-8")):
            for text in sentences(paragraph):
                by_text.setdefault(text, Sentence(f"{name}:{line}", text))
    return list(by_text.values())


def draw(every: list[Sentence], seed: int, number: int) -> list[Sentence]:
    """Return `number` different sentences, or all if there are fewer; the same seed draws the same ones."""
    return random.Random(seed).sample(every, min(number, len(every)))


# ---- helpers ----


def _files(kind: str) -> Iterator[tuple[Path, Callable[[str], Iterator[tuple[int, str]]]]]:
    if kind == "docs":
        for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
            if path.name != QUOTES:
                yield path, paragraphs_of_page
        for path in sorted((ROOT / "docs" / "notebooks").glob("*.py")):
            yield path, paragraphs_of_notebook
        return
    for top in PRODUCT:
        for path in sorted((ROOT / top).rglob("*.py")):
            yield path, docstrings if kind == "docstrings" else messages


def _shown(children: list[Token]) -> str:
    """Return the text that a reader sees: words of links, code in backticks, no targets, no pictures."""
    parts = []
    for child in children:
        match child.type:
            case "code_inline":
                parts.append(f"`{child.content}`")
            case "softbreak" | "hardbreak":
                parts.append(" ")
            case "text":
                parts.append(child.content)
    return "".join(parts)


def _plain_words(sentence: str) -> list[str]:
    return re.findall(r"(?<![\w/.{-])[A-Za-z][a-z']*(?=[\s,.;:!?)\"']|$)", sentence)


def _paragraphs(text: str, line: int) -> Iterator[tuple[int, str]]:
    if _MARKUP.search(text):
        return
    for paragraph in re.split(r"\n\s*\n|\n\s*(?=[-*] )", text):
        yield line, paragraph


def _with_values(node: ast.JoinedStr) -> str:
    parts = []
    for part in node.values:
        match part:
            case ast.Constant(str(text)):
                parts.append(text)
            case ast.FormattedValue():
                parts.append("{" + ast.unparse(part.value) + "}")
            case _:
                pass
    return "".join(parts)


def _all_docstrings(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in node.body:
                match statement:
                    case ast.Expr(ast.Constant(str(text))):
                        yield node, text, statement.lineno


def _is_command(node: ast.AST, source: str) -> bool:
    """True if a function's arguments are options of the command line, so that its docstring is its help."""
    if not isinstance(node, ast.FunctionDef) or node.name.startswith("_") or "typer" not in source:
        return False
    return any(mark in ast.unparse(node.args) for mark in _COMMAND_MARKS)


def main() -> int:
    parser = argparse.ArgumentParser(description="Draw sentences by seed, to be read by fresh eyes.")
    parser.add_argument("--of", required=True, choices=("docs", "messages", "docstrings"), dest="kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--number", type=int, default=40, help="how many are drawn")
    parser.add_argument("paths", nargs="*", metavar="PATH", help="only files and folders below these")
    options = parser.parse_args()
    every = all_sentences(options.kind, options.paths)
    sample = draw(every, options.seed, options.number)
    for index, sentence in enumerate(sample, start=1):
        print(f"{index:3} {sentence.place}\n    {sentence.text}")
    print(f"{len(sample)} of {len(every)} sentences of {options.kind}, seed {options.seed}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
