"""IIIF: a manifest (Presentation API 3) and its pictures as static tiles (Image API 3, level 0), in a folder that
a web server can serve unchanged."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from coupole.errors import InputError
from coupole.exchange.rti.lit_views import WHITE_QUANTILE, LitView, Picture, Said
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

MANIFEST = "manifest.json"
EXAMPLE_URL = "https://example.org/iiif"
_OF_ADDRESSES = re.compile(r"(?:[A-Za-z0-9\-._~:/?#\[\]@!$&'()*+,;=]|%[0-9A-Fa-f]{2})+")
_TILE_PX = 512
_LARGEST_WHOLE_PX = 1024
"""Largest size of scaled pictures that are stored in one piece, besides the full one."""
_QUALITY = 92
_RAKING_ELEVATION_DEG = 25.0
_SIDES = {"left": (-1.0, 0.0), "top": (0.0, 1.0), "right": (1.0, 0.0), "bottom": (0.0, -1.0)}


def write(views: Iterable[LitView], out: Path, base_url: str, say: Said) -> list[Path]:
    """Write a canvas for each view, with a choice of pictures: soft light, raking light from four sides, and
    normals if they are known.

    Ids begin with `base_url`, the future address of the folder. Returns the files, the manifest last. Raises
    InputError if the base is not an http address.
    """
    base = checked_base(base_url)
    paths: list[Path] = []
    canvases, origins = [], []
    for view in views:
        choices = []
        for kind, label, codes in _pictures(view, say):
            name = f"{view.name}-{kind}"
            paths += write_tiles(codes, out / name, f"{base}/{quote(name)}")
            choices.append(_image(f"{base}/{quote(name)}", label, view.size_px))
        canvases.append(_canvas(f"{base}/{quote(view.name)}", view, choices))
        origins.append(view.origin)
    manifest = {
        "@context": "http://iiif.io/api/presentation/3/context.json",
        "id": f"{base}/{MANIFEST}",
        "type": "Manifest",
        "label": _text(origins[0].split(",")[0]),
        "metadata": [{"label": _text("Origin"), "value": {"none": origins}}],
        "items": canvases,
    }
    write_synced(out / MANIFEST, json.dumps(manifest, indent=1) + "\n")
    return [*paths, out / MANIFEST]


def write_tiles(codes: NDArray[np.uint8], folder: Path, url: str) -> list[Path]:
    """Write a picture [h, w, 3] as tiles, scaled pictures and `info.json`, at their canonical addresses."""
    import cv2

    height, width = codes.shape[:2]
    factors = [1]
    while max(width, height) / factors[-1] > _TILE_PX:
        factors.append(2 * factors[-1])
    codes_by_address = {"full/max": codes}
    sizes = []
    for factor in factors:
        across, down = -(-width // factor), -(-height // factor)
        level = np.asarray(cv2.resize(codes, (across, down), interpolation=cv2.INTER_AREA), np.uint8)
        if max(across, down) <= _LARGEST_WHOLE_PX:
            sizes.append({"width": across, "height": down})
            codes_by_address[f"full/{across},{down}"] = level
        for top in range(0, down, _TILE_PX):
            for left_px in range(0, across, _TILE_PX):
                tile = level[top : top + _TILE_PX, left_px : left_px + _TILE_PX]
                if tile.shape != level.shape:
                    x, y = left_px * factor, top * factor
                    wide, high = (min(_TILE_PX * factor, side_px) for side_px in (width - x, height - y))
                    codes_by_address[f"{x},{y},{wide},{high}/{tile.shape[1]},{tile.shape[0]}"] = tile
    info = {
        "@context": "http://iiif.io/api/image/3/context.json",
        "id": url,
        "type": "ImageService3",
        "protocol": "http://iiif.io/api/image",
        "profile": "level0",
        "width": width,
        "height": height,
        "sizes": sizes[::-1],
        "tiles": [{"width": _TILE_PX, "height": _TILE_PX, "scaleFactors": factors}],
    }
    paths = [folder / address / "0" / "default.jpg" for address in codes_by_address]
    for path, part in zip(paths, codes_by_address.values(), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_jpeg(part))
    write_synced(folder / "info.json", json.dumps(info, indent=1) + "\n")
    return [*paths, folder / "info.json"]


def _pictures(view: LitView, say: Said) -> Iterator[tuple[str, str, NDArray[np.uint8]]]:
    """Yield kind, label and codes [h, w, 3] of each picture."""
    total = np.zeros((view.size_px[1], view.size_px[0], 3), np.float32)
    for number in range(len(view)):
        total += view.linear(number)
        say(f"{view.name}: soft light", number + 1, len(view))
    white = np.quantile(total.max(axis=2), WHITE_QUANTILE)
    yield "soft", "Soft light: the mean of all lights", _codes(srgb(total / max(white, np.float32(1e-9))))
    tilt = np.radians(_RAKING_ELEVATION_DEG)
    for side, (x, y) in _SIDES.items():
        direction = np.array([x * np.cos(tilt), y * np.cos(tilt), np.sin(tilt)])
        number = int(np.argmax(view.directions @ direction))
        elevation_deg = np.degrees(np.arcsin(view.directions[number, 2]))
        label = f"Light from the {side}, {elevation_deg:.0f} degrees above the picture's plane"
        yield side, label, _codes(view.encoded_picture(number))
    if view.normals is not None:
        yield "normals", "Normals: (n + 1) / 2 as red, green, blue", _codes((view.normals + 1.0) / 2.0)


def _codes(encoded_picture: Picture) -> NDArray[np.uint8]:
    codes: NDArray[np.uint8] = np.rint(255.0 * np.nan_to_num(encoded_picture)).clip(0, 255).astype(np.uint8)
    return codes


def _jpeg(codes: NDArray[np.uint8]) -> bytes:
    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(codes)).save(content, "JPEG", quality=_QUALITY, subsampling=0)
    return content.getvalue()


def _canvas(url: str, view: LitView, choices: list[dict[str, Any]]) -> dict[str, Any]:
    width, height = view.size_px
    canvas = {
        "id": f"{url}/canvas",
        "type": "Canvas",
        "label": _text(view.name),
        "width": width,
        "height": height,
        "items": [
            {
                "id": f"{url}/page",
                "type": "AnnotationPage",
                "items": [
                    {
                        "id": f"{url}/painting",
                        "type": "Annotation",
                        "motivation": "painting",
                        "body": {"type": "Choice", "items": choices},
                        "target": f"{url}/canvas",
                    }
                ],
            }
        ],
    }
    if view.pixel_mm is not None:
        size = f"{view.pixel_mm:.4g} (nominal, at the point in focus)"
        canvas["metadata"] = [{"label": _text("Size of a pixel in mm"), "value": {"none": [size]}}]
    return canvas


def _image(url: str, label: str, size_px: tuple[int, int]) -> dict[str, Any]:
    return {
        "id": f"{url}/full/max/0/default.jpg",
        "type": "Image",
        "format": "image/jpeg",
        "label": _text(label),
        "width": size_px[0],
        "height": size_px[1],
        "service": [{"id": url, "type": "ImageService3", "profile": "level0"}],
    }


def _text(words: str) -> dict[str, list[str]]:
    return {"en": [words]}


def checked_base(base_url: str) -> str:
    """Return the base without slashes at its end. Raises InputError if the base is not an http address, or has
    characters that an address must not have (RFC 3986, appendix A)."""
    try:
        parts = urlsplit(base_url)
        fits = parts.scheme in ("http", "https") and parts.hostname and (parts.port or 1) > 0
    except ValueError:  # invalid brackets, or an invalid port
        fits = False
    if not fits or "?" in base_url or "#" in base_url or not _OF_ADDRESSES.fullmatch(base_url):
        raise InputError(
            f"--base-url {base_url}: expected the http address under which the folder will be found, "
            f"for example {EXAMPLE_URL}; write characters that an address may not have with %, a blank as %20; "
            "the ids of IIIF contain this address"
        )
    return base_url.rstrip("/")
