"""Times and settings that raw files tell in their EXIF."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED_DATA
from tiny_dng import write_dng

from drivers.camera.raw.exif import read_exif

REAL_DNG = SHARED_DATA / "raw/colorchart.dng"
HEIGHT_PX, WIDTH_PX = 24, 40


class TestExif:
    """The reader of capture times."""

    @settings(deadline=None)
    @given(
        taken=st.datetimes(datetime(1990, 1, 1), datetime(2090, 1, 1)).map(lambda t: t.replace(microsecond=0)),
        subseconds=st.text("0123456789", max_size=6),
        exposure=st.tuples(st.integers(1, 2**31), st.integers(1, 2**31)),
        order=st.sampled_from("<>"),
    )
    def test_what_was_written_is_read_in_either_byte_order(
        self,
        tmp_path_factory: pytest.TempPathFactory,
        taken: datetime,
        subseconds: str,
        exposure: tuple[int, int],
        order: str,
    ) -> None:
        path = tmp_path_factory.mktemp("exif") / "IMG_0001.DNG"
        pixels = np.zeros((2, 2), np.uint16)
        stamp = f"{taken:%Y:%m:%d %H:%M:%S}"
        write_dng(path, pixels, taken=stamp, subseconds=subseconds, exposure=exposure, order=order)
        found = read_exif(path)
        seconds = int(taken.replace(tzinfo=UTC).timestamp())
        assert found.taken_ns == seconds * 10**9 + int(subseconds.ljust(9, "0"))
        assert found.resolution_us == 10 ** (6 - len(subseconds))
        assert found.exposure_us == pytest.approx(1e6 * exposure[0] / exposure[1])

    @pytest.mark.parametrize("iso", [400, (400, 100)])
    def test_the_first_sensitivity_counts(self, tmp_path: Path, iso: int | tuple[int, ...]) -> None:
        path = tmp_path / "IMG_0001.DNG"
        write_dng(path, np.zeros((2, 2), np.uint16), taken="2026:03:04 05:06:07", iso=iso)
        assert read_exif(path).iso == 400

    @settings(deadline=None)
    @given(content=st.binary(max_size=400), cut=st.integers(0, 400))
    def test_anything_else_is_refused_and_never_misread(
        self, tmp_path_factory: pytest.TempPathFactory, content: bytes, cut: int
    ) -> None:
        path = tmp_path_factory.mktemp("exif") / "IMG_0001.DNG"
        for data in (content, struct.pack("<2sHI", b"II", 42, 8) + content[:cut]):
            path.write_bytes(data)
            with pytest.raises(ValueError, match=r"it |its "):
                read_exif(path)
