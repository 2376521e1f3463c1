"""The page itself: its scripts, shaders, style and data, in one HTML file.

If the data would make the file larger than `MOST_BYTES`, they are put beside it, into `NAME.data/`, as scripts
that the page loads by script tags. A page that is opened from a disk can load nothing else.
"""

from __future__ import annotations

import json
from importlib import resources
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from coupole.errors import InputError, StorageError
from coupole.exchange.look.look_blocks import SCRIPT_BEGINS, Block, Look, in_script
from coupole.exchange.look.page_template import filled
from coupole.storage.durable import make_folder, sync_folder, write_synced

MOST_BYTES = 25_000_000
"""Greatest size of a page with all data inside, bytes."""
_POLICY = "script-src 'unsafe-inline' 'self' file:; style-src 'unsafe-inline'; img-src blob:"
_EARLY_BYTES = 3_000_000
SCRIPTS = (
    "vectors.js",
    "blocks.js",
    "state.js",
    "camera.js",
    "lights.js",
    "programs.js",
    "renderer.js",
    "tiles.js",
    "flat.js",
    "run.js",
    "scene.js",
    "material.js",
    "frames.js",
    "residual.js",
    "texels.js",
    "plot.js",
    "samples.js",
    "sphere.js",
    "overlay.js",
    "lengths.js",
    "annotations.js",
    "print.js",
    "beside.js",
    "controls.js",
    "theme.js",
    "pointer.js",
    "opening.js",
    "app.js",
    "main.js",
)
"""Scripts in the order in which a browser reads them."""
SHADERS = (
    "common.glsl",
    "surface.vert",
    "surface.frag",
    "flat.vert",
    "flat.frag",
    "planes.frag",
    "shadow.frag",
    "screen.vert",
    "shade.glsl",
    "texels.glsl",
    "light.frag",
    "face.glsl",
    "scene.vert",
    "scene.frag",
    "show.frag",
)


def write_page(look: Look, title: str, path: Path, most_bytes: int = MOST_BYTES) -> list[Path]:
    """Write the page; return its files, the page first. The data of an earlier page stay until the new page is
    written.

    Raises InputError if the name does not end in .html, or if the folder for its data contains other files;
    StorageError if it cannot be written.
    """
    if path.suffix.lower() != ".html":
        raise InputError(f"--out {path}: expected a name that ends in .html")
    data = path.with_suffix(".data")
    inside, beside = _shared_out(look, most_bytes)
    try:
        earlier = _earlier(data)
        make_folder(path.parent)
        with TemporaryDirectory(prefix=f".{data.name}.", dir=path.parent) as aside:
            new = Path(aside) / data.name
            for block in beside:
                make_folder(new)
                write_synced(new / f"{block.name}.js", block.script)
            write_synced(path, page_text(look, title, inside, data.name if beside else ""))
            _clear(data, earlier)
            if beside:
                new.rename(data)
        sync_folder(path.parent)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}. Choose another place, or free space.") from error
    return [path, *(data / f"{block.name}.js" for block in beside)]


def page_text(look: Look, title: str, inside: list[Block], data: str) -> str:
    """Return the HTML; `data` is the folder of the blocks outside the page, empty if there are none."""
    shaders = {name: _part(name) for name in SHADERS}
    names = [block.name for block in look.blocks]
    about = {**look.about, "title": title, "errors": look.errors, "blocks": names, "data": data}
    about["first"] = [block.name for block in look.first]
    scripts = "\n".join(_part(name) for name in SCRIPTS)
    early = _early(look, inside)
    tags = [f"<script>{block.script}</script>\n" for block in inside[early:]]
    inside_names = {block.name for block in inside}
    tags += [
        f'<script src="{quote(f"{data}/{name}.js")}"></script>\n' for name in names if name not in inside_names
    ]
    parts = {
        "ABOUT": in_script(about),
        "SHADERS": in_script(shaders),
        "SCRIPTS": scripts,
        "FIRST": "".join(f"<script>{block.script}</script>\n" for block in (*look.first, *inside[:early])),
        "BLOCKS": "".join(tags),
    }
    return filled(_part("page.html"), title, _part("page.css"), _POLICY, parts)


def _early(look: Look, inside: list[Block]) -> int:
    """Number of blocks in the page that stand before the scripts: the scripts begin with them while the rest is
    read."""
    if look.first:
        return 0
    sizes = accumulate(len(block.script) for block in inside)
    return max(len(look.blocks) if inside else 0, sum(size <= _EARLY_BYTES for size in sizes))


def _shared_out(look: Look, most_bytes: int) -> tuple[list[Block], list[Block]]:
    """Return the blocks that go into the page, and the blocks that go beside it.

    The blocks that a page needs to begin go into it all together, or not at all. Then the others go into it in
    their order, while there is room.
    """
    start_bytes = sum(len(block.script) for block in (*look.first, *look.blocks))
    free = most_bytes - _own_bytes() - len(json.dumps(look.about)) - start_bytes
    if free < 0:
        return [], [*look.blocks, *look.later]
    inside = list(look.blocks)
    for block in look.later:
        free -= len(block.script) + _TAGS
        if free < 0:
            break
        inside.append(block)
    return inside, [*look.blocks, *look.later][len(inside) :]


_TAGS = len("<script></script>\n")


def _own_bytes() -> int:
    return sum(len(_part(name)) for name in ("page.html", "page.css", *SCRIPTS, *SHADERS)) + 4096


def _earlier(data: Path) -> list[Path]:
    """Return the files of an earlier page's data. Raises InputError if the folder contains other files."""
    if not data.exists() and not data.is_symlink():
        return []
    paths = list(data.iterdir()) if data.is_dir() and not data.is_symlink() else [data]
    if not all(_is_script(path) for path in paths):
        raise InputError(f"{data}: holds something else than a page's data; name another page with --out")
    return paths


def _is_script(path: Path) -> bool:
    """Tell whether a file is one of a page's data."""
    if path.suffix != ".js" or path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(SCRIPT_BEGINS)) == SCRIPT_BEGINS.encode()


def _clear(data: Path, earlier: list[Path]) -> None:
    """Remove the data of an earlier page, and their folder."""
    for path in earlier:
        path.unlink()
    if data.exists():
        data.rmdir()


def _part(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text(encoding="utf-8")
