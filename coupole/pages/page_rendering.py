"""Writes the parts of a page as one HTML file that fetches nothing."""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.errors import StorageError, reason
from coupole.pages import palettes
from coupole.pages.page_parts import Page
from coupole.storage.durable import write_synced

if TYPE_CHECKING:
    from jinja2 import Environment


def render(page: Page, template: str = "page.html", **more: Any) -> str:
    """Return the page as HTML, with style and pictures in it. It has a script only if it has maps. `more` has
    values for a template that is not the one of all reports."""
    palette_names = sorted({figure.palette for figure in page.maps() if figure.palette})
    tables = {name: palettes.hexadecimal(name) for name in palette_names}
    return (
        _environment()
        .get_template(template)
        .render(page=page, palettes=tables, has_maps=bool(page.maps()), **more)
    )


def write_page(path: Path, page: Page) -> None:
    """Write the page. Raises StorageError."""
    try:
        write_synced(path, render(page))
    except OSError as error:
        raise StorageError(f"{path}: cannot write the page: {reason(error)}. Free its disk.") from error


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("coupole.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    environment.filters["figures"] = lambda value: f"{value:.4g}"
    environment.globals["gradient"] = palettes.gradient
    return environment
