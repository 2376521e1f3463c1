"""Paints by their K and S in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coupole.appearance.matter.paint_file import PaintFile, encode, read_paint
from coupole.errors import InputError

TEXT = """\
# coupole: paint 1
# name: ochre, fine
# unit: per mm
# binder_index: 1.5
# thickness_um: 30
wavelength_nm,K,S,u_K,u_S
400,9.5,20,0.3,0.4
420,8,21,0.2,0.4
440,5,22,0.1,0.4
"""


def written(folder: Path, text: str = TEXT) -> Path:
    (folder / "a.paint.csv").write_text(text)
    return folder / "a.paint.csv"


def test_a_paint_is_read_as_it_is_written_by_hand_and_by_the_program(tmp_path: Path) -> None:
    by_hand = read_paint(written(tmp_path))
    again = read_paint(written(tmp_path, encode(by_hand)))

    for paint in (by_hand, again):
        assert (paint.name, paint.unit, paint.binder_index) == ("ochre, fine", "per mm", 1.5)
        assert paint.head_lines["thickness_um"] == 30
        assert paint.absorption.tolist() == [9.5, 8.0, 5.0]
        assert paint.u_scattering.tolist() == [0.4, 0.4, 0.4]


def test_on_the_grid_it_is_straight_between_bands_and_held_beyond(tmp_path: Path) -> None:
    pigment = read_paint(written(tmp_path)).on_grid()

    assert pigment.absorption[[0, 4, 6, 80]] == pytest.approx([9.5, 9.5, 8.75, 5.0])


def test_further_columns_are_kept(tmp_path: Path) -> None:
    paint = read_paint(written(tmp_path))
    four = PaintFile(**{**vars(paint), "other": {"s_i": np.array([1.0, 2.0, 3.0])}})

    assert read_paint(written(tmp_path, encode(four))).other["s_i"].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# coupole: paint 1", "# a paint", ":1:1: expected `# coupole: paint 1`"),
        ("per mm", "per inch", "unit: expected per mm"),
        ("binder_index: 1.5", "binder_index: glass", "binder_index: expected 1 to 3"),
        ("wavelength_nm,K,S", "nm,S,K", ":6:1: expected columns"),
        ("420,8,21", "0.42,8,21", ":8:1: expected a wavelength in nm"),
        ("420,8,21", "435,8,21", ":8:1: expected rising wavelengths without gaps"),
        ("420,8,21", "420,-8,21", ":8:1: K: expected 0, found -8"),
        ("420,8,21", "420,8,0", ":8:1: S: expected more than 0, found 0"),
        ("420,8,21,0.2,0.4", "420,8,21,0.2", ":8:1: expected 5 numbers, found 4"),
        ("420,8,21", "420,8,nan", ":8:1: expected numbers"),
        ("# name: ochre, fine", "# name: [", ":2:1: expected YAML"),
    ],
)
def test_what_is_no_paint_is_refused_with_file_and_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_paint(written(tmp_path, TEXT.replace(old, new)))
    assert f"a.paint.csv{words}" in str(refused.value) or words in str(refused.value)
