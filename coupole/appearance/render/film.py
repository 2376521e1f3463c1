"""A film of pictures that show one scene at several times."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np


def write_film(pictures: Sequence[Path], path: Path, frames_per_s: int, about: str) -> None:
    """Write H.264 in MP4 from PNG pictures of one size; `about` becomes its comment. Raises OSError."""
    import av
    from PIL import Image

    with av.open(str(path), "w") as film:
        film.metadata["comment"] = about
        with Image.open(pictures[0]) as first:
            width, height = (side - side % 2 for side in first.size)
        stream = film.add_stream("libx264", rate=Fraction(frames_per_s))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "18"}
        for picture in pictures:
            with Image.open(picture) as image:
                pixels = np.asarray(image.convert("RGB"))[:height, :width]
            film.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        film.mux(stream.encode())
