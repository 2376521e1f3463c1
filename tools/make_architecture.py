"""Draws the project's packages and their dependencies, from the present imports: docs/pictures/rooms.svg.

    python tools/make_architecture.py [--output docs/pictures/rooms.svg]

Packages are arranged as a staircase in the order of import-linter's layers (pyproject.toml). A line leaves a
package to the right and ends on one that it uses; its width grows with the number of imports. None leads upwards.
"""

from __future__ import annotations

import argparse
import html
import tomllib
from collections import Counter
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parent.parent
OUTPUT = ROOT / "docs" / "pictures" / "rooms.svg"
CONTRACTS = (
    "bounded",
    "clock",
    "devices",
    "errors",
    "geometry",
    "joint_chain",
    "kernels",
    "kinematics",
    "supervision",
    "wrist_lengths",
)
BESIDE = ("drivers", "sim")
ENTRY = "__main__"
"""It only begins the commands, and counts as a part of them."""
_STEP_X, _STEP_Y, _BOX_W, _BOX_H, _MARGIN = 74, 46, 132, 34, 16


def rooms_in_order() -> list[str]:
    """Return the rooms from the top layer down, with the contracts merged, and drivers and simulation between plan
    and appearance."""
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = config["tool"]["importlinter"]["contracts"]
    layers = [name for name in contracts[0]["layers"] if name not in (*CONTRACTS, ENTRY)]
    place = layers.index("appearance")
    return [*layers[:place], *BESIDE, *layers[place:], "contracts"]


def room_of(module: str) -> str:
    """Return the package of a module."""
    parts = module.split(".")
    if parts[0] in BESIDE or len(parts) == 1:
        return parts[0]
    if parts[1] in CONTRACTS:
        return "contracts"
    return "commands" if parts[1] == ENTRY else parts[1]


def arrows() -> Counter[tuple[str, str]]:
    """Return the number of imports from one package into another."""
    graph = grimp.build_graph("coupole", *BESIDE, cache_dir=None)
    counts: Counter[tuple[str, str]] = Counter()
    for module in graph.modules:
        for dependency in graph.find_modules_directly_imported_by(module):
            pair = room_of(module), room_of(dependency)
            if pair[0] != pair[1] and "coupole" not in pair:
                counts[pair] += 1
    return counts


def purpose(room: str) -> str:
    """Return the first sentence of the package's docstring."""
    if room == "contracts":
        return "What all rooms agree on: devices, errors, frames of reference, a described arm."
    folder = ROOT / (room if room in BESIDE else f"coupole/{room}")
    text = (folder / "__init__.py").read_text(encoding="utf-8").split('"""')[1]
    return " ".join(text.split("\n\n")[0].split())


def size(room: str) -> int:
    """Lines of Python."""
    names = CONTRACTS if room == "contracts" else (room,)
    places = [ROOT / name if name in BESIDE else ROOT / "coupole" / name for name in names]
    files = [
        file for place in places for file in (*place.rglob("*.py"), place.with_suffix(".py")) if file.exists()
    ]
    return sum(path.read_text(encoding="utf-8").count("\n") for path in files)


def drawing() -> str:
    """Return the SVG. Its `desc` lists the arrows, one per line, so that a test can compare them."""
    rooms, count_of_arrow = rooms_in_order(), arrows()
    width = _MARGIN * 2 + _STEP_X * (len(rooms) - 1) + _BOX_W
    height = _MARGIN * 2 + _STEP_Y * (len(rooms) - 1) + _BOX_H
    description = "\n".join(sorted(f"{a} uses {b}" for a, b in count_of_arrow))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f"<title>Rooms of Coupole and which uses which</title><desc>{description}</desc>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for (user, provider), count in sorted(count_of_arrow.items()):
        i, j = rooms.index(user), rooms.index(provider)
        x, y = _MARGIN + i * _STEP_X + _BOX_W, _MARGIN + i * _STEP_Y + _BOX_H / 2
        at = _MARGIN + j * _STEP_X + 20 + 92 * (i + 1) / (len(rooms) + 1)
        end = _MARGIN + j * _STEP_Y
        colour = "#b03030" if i > j else "#6d8fb3"
        line = min(5.0, 0.6 + count**0.5 / 3)
        parts.append(
            f'<path d="M{x} {y:.1f} L{at:.1f} {y:.1f} L{at:.1f} {end:.1f}" fill="none" stroke="{colour}" '
            f'stroke-width="{line:.2f}" stroke-opacity="0.55"/>'
            f'<path d="M{at - 3:.1f} {end - 6} L{at:.1f} {end} L{at + 3:.1f} {end - 6}" fill="none" '
            f'stroke="{colour}"/>'
        )
    for n, room in enumerate(rooms):
        x, y = _MARGIN + n * _STEP_X, _MARGIN + n * _STEP_Y
        fill = "#e7dcc5" if room in BESIDE else "#dfe8d8" if room == "contracts" else "#dbe6f2"
        parts.append(
            f'<g><title>{html.escape(purpose(room))}</title><rect x="{x}" y="{y}" width="{_BOX_W}" '
            f'height="{_BOX_H}" rx="4" fill="{fill}" stroke="#44566b"/>'
            f'<text x="{x + 8}" y="{y + 15}" font-size="13" fill="#14202c">{room}</text>'
            f'<text x="{x + 8}" y="{y + 28}" font-size="10" fill="#4a5a6a">{size(room):,} lines</text></g>'
        )
    return "\n".join([*parts, "</svg>", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.parse_args().output.write_text(drawing(), encoding="utf-8")


if __name__ == "__main__":
    main()
