"""Targets: materials and poses that other programs have written."""

from __future__ import annotations

import math
import struct
from pathlib import Path

from fuzz.target import Target

ALTA = b"#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n#PARAM_OUT INV_STERADIAN\n#VS 2\n0.1 0.2 0 1.5 1.25 2\n"
CAMERAS = "1 OPENCV 400 300 800 801 200 150 -0.1 0.02 0.0001 0\n"
IMAGES = b"# images\n1 1 0 0 0 0.5 0.25 900 1 top.png\n3 4 7 5 6 8\n2 0.8 0.6 0 0 1 2 800 1 side.png\n\n"


def tensor_file() -> list[bytes]:
    """A small table of RGL's format, of rising values."""
    shapes = {"theta_i": (2,), "phi_i": (1,), "ndf": (2, 2), "sigma": (2, 2), "vndf": (1, 2, 2, 2)}
    sizes = {**shapes, "rgb": (1, 2, 3, 2, 2), "jacobian": (1,)}
    head, values = b"tensor_file\0\1\0" + struct.pack("<I", len(sizes)), b""
    first = len(head) + sum(13 + len(name) + 8 * len(shape) for name, shape in sizes.items())
    for name, shape in sizes.items():
        count, kind = math.prod(shape), 1 if name == "jacobian" else 10
        head += struct.pack("<H", len(name)) + name.encode() + struct.pack("<HB", len(shape), kind)
        head += struct.pack(f"<Q{len(shape)}Q", first + len(values), *shape)
        values += b"\1" if kind == 1 else struct.pack(f"<{count}f", *range(1, count + 1))
    return [head + values]


def read_tensor_file(path: Path) -> None:
    from coupole.appearance.matter.rgl_table import read_bsdf

    read_bsdf(path)


def read_alta_text(path: Path) -> None:
    from coupole.appearance.matter.alta_samples import read_alta

    read_alta(path)


def binary_images() -> list[bytes]:
    images = [struct.pack("<Q", 2)]
    for number, name in enumerate((b"top.png", b"side.png"), start=1):
        images.append(struct.pack("<I7dI", number, 1, 0, 0, 0, 0.5, 0.25, 900, 1) + name + b"\0")
        images.append(struct.pack("<Qddq", 1, 3.0, 4.0, 7))
    return [b"".join(images)]


def binary_cameras(folder: Path) -> None:
    lens = (800.0, 801.0, 200.0, 150.0, -0.1, 0.02, 1e-4, 0.0)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 1, 4, 400, 300, *lens))


def text_cameras(folder: Path) -> None:
    (folder / "cameras.txt").write_text(CAMERAS)


def read_poses(path: Path) -> None:
    from coupole.reflectance.alignment.colmap_model import read_model

    read_model(path.parent)


FOREIGN = (
    Target("bsdf", "objects/case.bsdf", tensor_file, read_tensor_file),
    Target("alta", "objects/case.alta", lambda: [ALTA], read_alta_text),
    Target("colmap-text", "objects/text/images.txt", lambda: [IMAGES], read_poses, text_cameras),
    Target("colmap-binary", "objects/binary/images.bin", binary_images, read_poses, binary_cameras),
)
