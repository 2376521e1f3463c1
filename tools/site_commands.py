"""Reference pages that describe each command by its help: one page for each heading of `coupole --help`."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import typer

from coupole.commands.cli import GROUPS, app
from coupole.commands.examples import EXAMPLES, HEADING
from site_source import DOCS

FOLDER = "reference/commands"
PAGE = "reference/commands.md"


def pages() -> dict[str, str]:
    """Return the Markdown of the pages, by their path in `docs/`."""
    top = typer.main.get_command(app)
    texts = {PAGE: (DOCS / PAGE).read_text(encoding="utf-8")}
    for heading, names in GROUPS.items():
        title, page = f"## {heading}\n\n", f"commands/{_slug(heading)}.md"
        if title not in texts[PAGE]:
            raise SystemExit(f"docs/{PAGE}: expected the heading {heading} of `coupole --help`")
        texts[PAGE] = texts[PAGE].replace(title, f"{title}[Arguments, options and examples]({page})\n\n")
        parts = [f"# {heading}\n"]
        for name in names:
            parts += _description(top.commands[name], name)  # type: ignore[attr-defined]
        texts[f"{FOLDER}/{_slug(heading)}.md"] = "\n".join(parts)
    return texts


def _slug(heading: str) -> str:
    return re.sub(r"[^a-z]+", "-", heading.lower()).strip("-")


def _description(command: Any, name: str) -> Iterator[str]:
    if not name.endswith(" from"):
        yield f"## coupole {name}\n"
    else:
        yield f"### Options of `coupole {name.removesuffix(' from')}` without a step\n"
    yield inspect.cleandoc(command.help or "") + "\n"
    steps = getattr(command, "commands", {})
    if not steps:
        yield from _parameters(command)
    yield f"{HEADING}\n\n```sh"
    yield from (f"coupole {example}" for example in EXAMPLES[name])
    yield "```\n"
    for step in steps.values():
        yield from _description(step, f"{name} {step.name}")


def _parameters(command: Any) -> Iterator[str]:
    context = command.make_context(command.name, [], resilient_parsing=True)
    parameters = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    yield "| argument or option | is |"
    yield "|---|---|"
    for parameter in parameters:
        names = "`, `".join(parameter.opts) if parameter.param_type_name == "option" else parameter.name.upper()
        words = [(parameter.help or "").rstrip(".")]
        if parameter.required:
            words.append("required")
        default = None if parameter.required else parameter.get_default(context)
        if getattr(parameter, "show_default", False) and default not in (None, False, "", (), []):
            words.append(f"default: {default}")
        yield f"| `{names}` | {_cell('; '.join(words))} |"
    yield ""


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;")
