"""A frame as TIFF: 16 bits, grey, the camera's values; metadata are JSON in ImageDescription."""

from __future__ import annotations

import io
import json

import coupole
from coupole.exchange.exported_frame import Picture


def encode(picture: Picture) -> bytes:
    """Return the whole file. For a colour sensor it has the mosaic, with pattern and levels in the metadata."""
    import tifffile

    about = {
        **picture.about,
        "bayer_pattern": picture.pattern,
        "black_dn": picture.black_dn,
        "white_dn": picture.white_dn,
    }
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        picture.pixels,
        photometric="minisblack",
        description=json.dumps(about),
        software=f"coupole {coupole.__version__}",
        metadata=None,
    )
    return buffer.getvalue()
