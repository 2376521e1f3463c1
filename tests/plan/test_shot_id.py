"""Shot ids: written and read in one place, bounded, nothing but what was written is read."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.plan.shot_id import MAX_CHARACTERS, Dark, Led, Panel, PanelMark, ShotId, ShotLabel

LIGHTS = st.one_of(
    st.integers(0, 65_534).map(Led),
    st.integers(1, 4).map(Panel),
    st.builds(PanelMark, st.integers(1, 4), st.integers(0, 9)),
    st.integers(0, 2_000).map(Dark),
)
LABELS = st.builds(ShotLabel, LIGHTS, st.integers(0, 15), st.integers(0, 999))
VIEWS = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,40}", fullmatch=True)


@given(VIEWS, LABELS)
def test_an_id_comes_back_from_its_text(view: str, label: ShotLabel) -> None:
    assert ShotId.parse(str(ShotId(view, label))) == ShotId(view, label)


@pytest.mark.parametrize(
    ("text", "light"),
    [
        ("top/led0417/e0", Led(417)),
        ("top/led12000/e3", Led(12_000)),
        ("top/panel2/e1/r3", Panel(2)),
        ("top/panel2-mark4/e0", PanelMark(2, 4)),
        ("a.b-c_d/dark11/e0", Dark(11)),
    ],
)
def test_ids_as_they_stand_on_disks(text: str, light: object) -> None:
    assert ShotId.parse(text).light == light
    assert str(ShotId.parse(text)) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "top",
        "/led0417/e0",
        "top/led417/e0",
        "top/led00417/e0",
        "top/led0417",
        "top/led0417/e0/r0",
        "top/led0417/e00",
        "top/led0417/e0/r2/x",
        "top/led0417/e0 ",
        "top/lamp3/e0",
        "x" * MAX_CHARACTERS + "/led0417/e0",
    ],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        ShotId.parse(text)


@pytest.mark.parametrize(
    ("text", "is_shot", "is_dark"),
    [
        ("v/led0001/e0", True, False),
        ("v/panel1/e0", True, False),
        ("v/panel1-mark0/e0", False, False),
        ("v/dark0/e0", False, True),
        ("darkroom-mark/led0001/e0", True, False),
    ],
)
def test_shots_are_told_from_marks_and_dark_frames(text: str, is_shot: bool, is_dark: bool) -> None:
    shot = ShotId.parse(text)
    assert (shot.is_shot, shot.is_dark) == (is_shot, is_dark)
