"""Linear pictures as files: NumPy, OpenEXR, PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError, reason

SUFFIXES = (".npy", ".exr", ".png")
_PNG_WHITE = 65535


def refuse_unknown(path: Path) -> None:
    """Raise InputError if there is no writer for this kind of file."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")


def write_picture(path: Path, picture: NDArray[np.float32]) -> None:
    """Write [h, w, 3] red, green, blue, completely or not at all. A PNG has 16 bits, is linear, and holds only
    values from 0 to 1; the other kinds hold all values.

    Raises InputError for any other kind of file, StorageError if it cannot be written.
    """
    refuse_unknown(path)
    part = path.with_name(f".{path.name}.part")
    try:
        match path.suffix.lower():
            case ".npy":
                with part.open("wb") as file:
                    np.save(file, picture)
            case ".exr":
                header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
                OpenEXR.File(header, {"RGB": np.ascontiguousarray(picture)}).write(str(part))
            case _:
                import cv2

                codes = np.rint(np.clip(picture, 0.0, 1.0) * _PNG_WHITE).astype(np.uint16)
                part.write_bytes(cv2.imencode(".png", codes[..., ::-1])[1].tobytes())
        part.replace(path)
    except (OSError, RuntimeError) as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    finally:
        part.unlink(missing_ok=True)
