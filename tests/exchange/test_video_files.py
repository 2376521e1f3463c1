"""Videos, read back by OpenCV's own decoder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from coupole.errors import InputError
from coupole.exchange.video_files import write_video


def test_colours_are_those_of_srgb(tmp_path: Path) -> None:
    """Of sRGB's own table: linear 0.2140 is shown by 127.5 of 255, 0.0331 by 51, 1 and more by 255."""
    colours = np.array([[0.214, 0.214, 0.214], [1.0, 0.0331, 0.0331], [0.0331, 0.214, 9.0], [0.0, 0.0, 0.0]])
    picture = np.repeat(np.repeat(colours[None], 49, 0), 32, 1).astype(np.float32)  # 49 x 128
    write_video(tmp_path / "a.mp4", [3.0 * picture] * 3, white=3.0, about="patches")
    reader = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1].astype(float))
    assert len(frames) == 3
    assert frames[0].shape == (48, 128, 3)
    assert reader.get(cv2.CAP_PROP_FPS) == 25
    wanted = np.array([[127.5, 127.5, 127.5], [255, 51, 51], [51, 127.5, 255], [0, 0, 0]])
    for number, colour in enumerate(wanted):
        np.testing.assert_allclose(frames[1][24, 32 * number + 16], colour, atol=4)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_a_video_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.mp4"):
        write_video(tmp_path / "a.gif", [], white=1.0, about="")
