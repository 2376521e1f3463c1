"""Builds the documentation site: `tools/site` calls this in an environment with the dependency group `site`.

tools/site [--to FOLDER] [--do-not-run]     into build/site; notebooks without their outputs
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import site_checks
import site_commands
import site_notebooks
import site_source
from site_source import REPO

SETTINGS: dict[str, Any] = {
    "project": "Coupole",
    "html_title": "Coupole",
    "language": "en",
    "extensions": ["myst_parser"],
    "myst_heading_anchors": 6,
    "myst_links_external_new_tab": False,
    "nitpicky": True,
    "html_theme": "furo",
    "html_copy_source": False,
    "html_show_copyright": False,
    "html_show_sphinx": False,
    "html_permalinks": True,
    "pygments_style": "default",
}

_BUTTONS = '<div class="content-icon-container">'


def build(to: Path, *, run: bool) -> list[str]:
    """Build the site into the folder `to`, which is made anew; return the faults."""
    from sphinx.application import Sphinx
    from sphinx.util.console import nocolor

    work = REPO / "build"
    notebooks = work / "site-notebooks"
    pages = site_commands.pages() | site_notebooks.pages(notebooks, run=run)
    source = site_source.stage(work / "site-source", made_pages=pages, made_files=notebooks / "outputs")
    if source.broken_links:
        return source.broken_links
    shutil.rmtree(to, ignore_errors=True)
    nocolor()
    application = Sphinx(
        srcdir=source.folder,
        confdir=None,
        outdir=to,
        doctreedir=work / "site-doctrees",
        buildername="html",
        confoverrides=SETTINGS,
        status=None,
        warning=sys.stderr,
        freshenv=True,
        warningiserror=True,
        exception_on_warning=False,
    )
    application.build(force_all=True)
    if application.statuscode:
        return ["Sphinx found the above"]
    for page in to.rglob("*.html"):  # Furo's buttons beside the article belong to no landmark
        text = page.read_text(encoding="utf-8")
        page.write_text(
            text.replace(_BUTTONS, f'{_BUTTONS[:-1]} role="region" aria-label="View">'), encoding="utf-8"
        )
    return site_checks.findings(to)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=REPO / "build/site", help="folder of the site; made anew")
    parser.add_argument("--do-not-run", action="store_true", help="show the notebooks without outputs")
    options = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if wrong := build(options.to, run=not options.do_not_run):
        print(*wrong, sep="\n", file=sys.stderr)
        print(f"the site is not right: {len(wrong)} finding(s)", file=sys.stderr)
        return 1
    print(f"{options.to / 'index.html'}: {site_checks.landing_bytes(options.to) / 1000:.0f} kB at first sight")
    return 0


if __name__ == "__main__":
    sys.exit(main())
