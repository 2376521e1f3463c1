"""The notebooks of `docs/notebooks` (py:percent), run in a kernel, as pages with their outputs.

They run one after the other in one folder, as a reader would run them, because later ones use the run of the
first. Only the pages, their figures and the notebooks for download are kept.
"""

from __future__ import annotations

import base64
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from site_source import DOCS, NOTEBOOKS

ORDER = ("first_acquisition", "frames_to_numbers", "reflectance", "your_own_led_box", "pigment")
LONGEST_S = 900
"""Longest time for one cell."""


def pages(folder: Path, *, run: bool) -> dict[str, str]:
    """Return the Markdown of the notebooks by their path in `docs/`; their figures are in the folder
    `folder`/outputs.

    Without `run` they have no outputs. Raises CellExecutionError if a cell fails.
    """
    import jupytext
    import nbformat

    names = {path.stem for path in (DOCS / NOTEBOOKS).glob("*.py")}
    if names != set(ORDER):
        raise SystemExit(f"ORDER of tools/site_notebooks.py and {DOCS / NOTEBOOKS} differ: {names ^ set(ORDER)}")
    shutil.rmtree(folder, ignore_errors=True)
    work, outputs = folder / "work", folder / "outputs"
    work.mkdir(parents=True)
    outputs.mkdir()
    texts = {}
    for name in ORDER:
        notebook = jupytext.read(DOCS / NOTEBOOKS / f"{name}.py", fmt="py:percent")
        if run:
            _run(notebook, work, name)
        nbformat.write(notebook, outputs / f"{name}.ipynb")
        texts[f"{NOTEBOOKS}/{name}.md"] = _page(notebook, name, outputs)
    return texts


def _run(notebook: Any, work: Path, name: str) -> None:
    from nbclient import NotebookClient
    from traitlets.config import Config

    print(f"notebook {name}", file=sys.stderr, flush=True)
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    where = {"metadata": {"path": str(work)}}
    with tempfile.TemporaryDirectory() as sockets:  # files that no other user of this machine can read
        config = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        NotebookClient(
            notebook, timeout=LONGEST_S, kernel_name="python3", config=config, resources=where
        ).execute()


def _page(notebook: Any, name: str, outputs: Path) -> str:
    parts = []
    figures = 0
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source.strip()}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                figures += 1
                picture = f"{name}-{figures}.png"
                (outputs / picture).write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![Figure {figures} of this notebook, drawn by the code above it]({picture})")
            elif output.get("name") != "stderr" and (text := output.get("text") or data.get("text/plain")):
                parts.append(f"```text\n{text.rstrip()}\n```")
    heading, _, rest = "\n\n".join(parts).partition("\n")
    download = f"*This page is a [notebook to download]({name}.ipynb); `docs/notebooks/{name}.py` is its source.*"
    return f"{heading}\n\n{download}\n{rest}\n"
