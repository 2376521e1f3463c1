"""Templates of the pages with a canvas: their common head, and their parts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape

_HEAD = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; {policy}; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}
</style>
</head>
"""


def filled(template: str, title: str, style: str, policy: str, parts: Mapping[str, str]) -> str:
    """Return the HTML of a template, in which `%NAME%` stands for a part, and `%TITLE%` for the escaped title.
    `policy` is the part of the Content-Security-Policy that allows the page its own scripts and styles."""
    contents = {**parts, "TITLE": escape(title)}
    names = "|".join(contents)
    body = re.sub(f"%({names})%", lambda found: contents[found[1]], template)
    return _HEAD.format(policy=policy, title=escape(title), style=style) + body
