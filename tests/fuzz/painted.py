"""Targets: paints, spectra's films and indices that a user names in files."""

from __future__ import annotations

from pathlib import Path

from fuzz.target import Target

_NM = range(380, 781, 20)
PAINT = (
    "# coupole: paint 1\n# name: ochre\n# unit: per mm\n# binder_index: 1.5\nwavelength_nm,K,S,u_K,u_S\n"
    + "".join(f"{nm},{9 - nm / 100},20.5,0.1,0.4\n" for nm in _NM)
)
INDEX = "REFERENCES: mine\nDATA:\n  - type: tabulated nk\n    data: |\n" + "".join(
    f"        {nm / 1000:g} 1.6 0.3\n" for nm in _NM
)
FILMS = """\
name: ochre
noise: 0.005
films:
  - {spectrum: film.csv, over: white.csv, thickness_um: 20, u_thickness_um: 1}
  - {spectrum: hiding.csv}
"""


def read_paint(path: Path) -> None:
    from coupole.appearance.matter.paint_file import read_paint

    read_paint(path)


def read_index(path: Path) -> None:
    from coupole.appearance.optics.index_file import read_index

    read_index(path)


def read_films(path: Path) -> None:
    """What `coupole layer` reads of its file and three spectra beside it."""
    from coupole.commands.layer import read_films
    from coupole.heritage.analysis.layer_samples import read_samples

    for name, value in (("film", 0.5), ("white", 0.8), ("hiding", 0.3)):
        rows = "".join(f"{nm},{value}\n" for nm in _NM)
        (path.parent / f"{name}.csv").write_text(f"nm,R\n{rows}")
    read_samples(*read_films(path))


PAINTED = (
    Target("paint", "plans/case.paint.csv", lambda: [PAINT.encode()], read_paint),
    Target("index", "plans/case.yml", lambda: [INDEX.encode()], read_index),
    Target("films", "plans/films.yaml", lambda: [FILMS.encode()], read_films),
)
