"""The option `--smallest` of every bench and proof: a size of seconds.

It shows that a tool still runs to its end and prints its figures, but the figures are not meaningful.
`tests/tools/test_smallest.py` runs every tool in this way.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any


class _Smallest(argparse.Action):
    """Sets the destination to True, and other options to small values."""

    def __init__(self, option_strings: Sequence[str], dest: str, values: dict[str, Any], **about: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, default=False, **about)
        self._values = values

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option: str | None = None,
    ) -> None:
        vars(namespace).update({self.dest: True, **self._values})


def add_smallest(parser: argparse.ArgumentParser, **values: Any) -> None:
    """Add `--smallest` to a parser. It sets other options, by their destinations; options that come after it on
    the command line still apply."""
    destinations = {action.dest for action in parser._actions}
    assert destinations.issuperset(values), f"{sorted(set(values) - destinations)}: the parser has no such option"
    options = " ".join(f"--{name.replace('_', '-')} {_as_text(value)}" for name, value in values.items())
    help_text = "a size of seconds: shows that it runs, no more" + (f" (with {options})" if options else "")
    parser.add_argument("--smallest", action=_Smallest, values=values, help=help_text)


def _as_text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
