"""Videos of linear pictures: H.264 in MP4, encoded as sRGB."""

from __future__ import annotations

import io
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError, reason
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

SUFFIX = ".mp4"
FRAMES_PER_S = 25
_CODEC = "libx264"
_QUALITY = "18"
"""Constant rate factor of x264; losses are hardly visible."""
_BT709, _SRGB, _LIMITED = 1, 13, 1
"""ITU-T H.273: primaries and matrix, transfer characteristics, range."""


def refuse_unknown(path: Path) -> None:
    """Raise InputError if this is not the name of a video."""
    if path.suffix.lower() != SUFFIX:
        raise InputError(f"{path}: expected a name that ends in {SUFFIX}")


def write_video(path: Path, pictures: Iterable[NDArray[np.float32]], *, white: float, about: str) -> None:
    """Write pictures [h, w, 3], linear, with `white` as the brightest value, as a video with the comment `about`,
    completely or not at all. An odd last row or column is left out, because the format halves the resolution of
    colour.

    Raises InputError for any other kind of file or without x264, StorageError if it cannot be written.
    """
    import av

    refuse_unknown(path)
    if _CODEC not in av.codecs_available:
        raise InputError(f"{path}: this PyAV has no {_CODEC}; install the wheel `av` of its maintainers")
    whole = io.BytesIO()
    with av.open(whole, "w", format="mp4") as video:
        video.metadata["comment"] = about
        stream = video.add_stream(_CODEC, rate=Fraction(FRAMES_PER_S), options={"crf": _QUALITY})
        assert isinstance(stream, av.VideoStream)
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = _BT709
        context.color_trc, context.color_range = _SRGB, _LIMITED
        for picture in pictures:
            height, width = (2 * (size // 2) for size in picture.shape[:2])
            if not context.is_open:
                stream.width, stream.height = width, height
            pixels = np.rint(255.0 * srgb(picture[:height, :width] / white)).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            yuv_frame = frame.reformat(
                format="yuv420p", src_colorspace=_BT709, dst_colorspace=_BT709, dst_color_range=_LIMITED
            )
            video.mux(stream.encode(yuv_frame))
        video.mux(stream.encode(None))
    try:
        write_synced(path, whole.getvalue())
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
