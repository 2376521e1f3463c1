"""Plainness of names and docstrings, limited by bounds that may only go down: part of `tools/check`.

    python tools/check_words.py [--show] [ROOM ...]

Two shares are counted in each room (`coupole/*`, `drivers`, `sim`, `tools`):

- *names*: bound names (variables, parameters, fields, functions) that are only a participle or pronoun, like
  `found` or `mine`. They do not say what they hold.
- *fragments*: docstrings that begin with a preposition or a relative word, like "Of a view". Their subject is
  missing.

Bounds and lists of words are in `tools/words.toml`. Exits with 1 if a share is above its bound; `--show` prints
every case.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WORDS = ROOT / "tools" / "words.toml"
FRAGMENT = re.compile(
    r"^(About|After|Among|As|At|Before|Beside|Between|But|By|For|From|How|If|In|Into|Like|Of|On|Only|Over|Than|That|"
    r"Those|Through|To|Under|Until|Upon|What|When|Where|Whether|Which|While|Who|Whose|Why|With|Within|Without) "
)


@dataclass
class Room:
    """Counts of one folder, and the places of all cases."""

    names: int = 0
    docstrings: int = 0
    bare: list[str] = field(default_factory=list)
    fragments: list[str] = field(default_factory=list)

    def shares(self) -> dict[str, float]:
        """Return both shares, in percent."""
        return {
            "names": 100.0 * len(self.bare) / max(1, self.names),
            "fragments": 100.0 * len(self.fragments) / max(1, self.docstrings),
        }


@cache
def words(kind: str) -> frozenset[str]:
    """Return a list of words: `pronouns`, irregular `participles`, or `no_participles`, which only look like
    participles."""
    return frozenset(tomllib.loads(WORDS.read_text(encoding="utf-8"))["words"][kind].split())


def is_bare(name: str) -> bool:
    """Tell whether a name is only one participle or pronoun."""
    word = name.strip("_")
    if word in words("no_participles") or "_" in word:
        return False
    return word in words("pronouns") | words("participles") or bool(re.fullmatch(r"[a-z]{2,}ed", word))


def bound_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Names that this module binds, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.alias) and node.asname:
            yield node.asname, node.lineno


def docstrings(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Docstrings of modules, classes, functions and fields, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in node.body:
                match statement:
                    case ast.Expr(ast.Constant(str(text))):
                        yield text, statement.lineno


def room_of(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return "/".join(parts[:2]) if parts[0] == "coupole" and len(parts) > 2 else parts[0]


def count() -> dict[str, Room]:
    """Return the counts of all rooms, by name."""
    rooms: dict[str, Room] = {}
    for top in ("coupole", "drivers", "sim", "tools"):
        for path in sorted((ROOT / top).rglob("*.py")):
            room, tree = rooms.setdefault(room_of(path), Room()), ast.parse(path.read_text(encoding="utf-8"))
            place = path.relative_to(ROOT)
            for name, line in bound_names(tree):
                room.names += 1
                room.bare += [f"{place}:{line}: {name}"] if is_bare(name) else []
            for text, line in docstrings(tree):
                room.docstrings += 1
                first = " ".join(text.split())
                room.fragments += [f"{place}:{line}: {first[:70]}"] if FRAGMENT.match(first) else []
    return rooms


def main() -> int:
    parser = argparse.ArgumentParser(description="Bare names and fragments, against their bounds.")
    parser.add_argument("--show", action="store_true", help="print every case")
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help="only these")
    options = parser.parse_args()
    bounds = tomllib.loads(WORDS.read_text(encoding="utf-8"))["most_percent"]
    wrong = 0
    for name, room in sorted(count().items()):
        if options.rooms and name not in options.rooms:
            continue
        shares, most = room.shares(), bounds.get(name, bounds["else"])
        for kind, share in shares.items():
            above = share > most[kind]
            wrong += above
            if above or options.show:
                print(f"{name}: {kind} {share:.1f} %, at most {most[kind]:g} %{' <-- above' if above else ''}")
        if options.show:
            print(*room.bare, *room.fragments, sep="\n")
    print(f"words: {wrong} shares above their bounds" if wrong else "words: all within bounds")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
