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


CUBE = (
    "ENVI\ndescription = {a panel}\nsamples = 2\nlines = 3\nbands = 4\nheader offset = 0\ndata type = 12\n"
    "interleave = bil\nbyte order = 0\nbbl = {1, 1, 1, 0}\nwavelength units = Nanometers\n"
    "reflectance scale factor = 1000\ndata ignore value = 9\nwavelength = {400, 500,\n 600, 700}\n"
)
LINE = "name,x_mm,y_mm," + ",".join(map(str, _NM)) + "\n"
LINE += "".join(f"p{row},{row},{2 * row}," + ",".join(["0.4"] * len(_NM)) + "\n" for row in range(3))


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


def read_cube(path: Path) -> None:
    from coupole.appearance.spectra.envi_cube import open_cube

    (path.parent / "case.dat").write_bytes(bytes(48))
    cube = open_cube(path)
    for first, end in cube.blocks():
        cube.read_rows(first, end)


def read_line_of_points(path: Path) -> None:
    from coupole.heritage.pigment_maps.line_points import is_line, read_line

    if is_line(path):
        read_line(path)


PAINTED = (
    Target("cube", "plans/case.hdr", lambda: [CUBE.encode()], read_cube),
    Target("line-of-points", "plans/case.csv", lambda: [LINE.encode()], read_line_of_points),
    Target("paint", "plans/case.paint.csv", lambda: [PAINT.encode()], read_paint),
    Target("index", "plans/case.yml", lambda: [INDEX.encode()], read_index),
    Target("films", "plans/films.yaml", lambda: [FILMS.encode()], read_films),
)
