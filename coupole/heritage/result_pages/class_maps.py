"""Files of the maps of an image cube: a picture with a legend, ENVI's classification, confidence and regions, and
the mean spectra."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from coupole.appearance.spectra.envi_cube import Cube
from coupole.errors import StorageError, reason
from coupole.heritage.pigment_maps.image_identification import NOT_LOOKED_AT, ImageFinding
from coupole.heritage.result_pages.class_colours import RGB, code_colours, with_legend
from coupole.pages.maps import picture_png
from coupole.storage.durable import write_synced

CLASSES, CONFIDENCE, REGIONS = "classes", "confidence", "regions"


def legend_of(finding: ImageFinding) -> list[tuple[str, RGB]]:
    """Names with shares, and colours, of the codes that occur."""
    total = max(finding.looked_at, 1)
    rows = []
    for code, colour in enumerate(code_colours(len(finding.names))):
        if pixels := finding.pixels_of(code):
            share = "" if code == NOT_LOOKED_AT else f", {pixels / total:.1%}"
            rows.append((f"{finding.names[code]}{share}", colour))
    return rows


def class_picture(finding: ImageFinding) -> bytes:
    """The map in colours as PNG, with its legend."""
    colours = np.array(code_colours(len(finding.names)), np.uint8)
    return with_legend(colours[finding.codes], legend_of(finding))


def write_maps(folder: Path, finding: ImageFinding, cube: Cube) -> list[Path]:
    """Write all files, and return their paths. Raises StorageError."""
    from spectral.io import envi

    colours = code_colours(len(finding.names))
    place = {"description": f"of {cube.header.name} by coupole identify"} | {
        name: cube.fields[name] for name in ("map info", "coordinate system string") if name in cube.fields
    }
    try:
        write_synced(folder / f"{CLASSES}.png", class_picture(finding))
        write_synced(folder / "seen.png", picture_png(finding.picture))
        write_synced(folder / f"{REGIONS}.csv", _spectra(finding, cube))
        names = [name.replace(",", " ") for name in finding.names]
        options: dict[str, Any] = {"force": True, "interleave": "bsq", "metadata": place, "ext": ".img"}
        envi.save_classification(
            str(folder / f"{CLASSES}.hdr"), finding.codes, class_names=names, class_colors=colours, **options
        )
        envi.save_image(str(folder / f"{CONFIDENCE}.hdr"), finding.confidence[:, :, None], **options)
        envi.save_image(str(folder / f"{REGIONS}.hdr"), finding.region_numbers[:, :, None], **options)
    except OSError as error:
        raise StorageError(f"{folder}: {reason(error)}") from error
    endings = {CLASSES: (".png", ".hdr", ".img"), CONFIDENCE: (".hdr", ".img"), REGIONS: (".csv", ".hdr", ".img")}
    paths = [folder / f"{name}{ending}" for name, ends in endings.items() for ending in ends]
    return [*paths, folder / "seen.png"]


def map_document(finding: ImageFinding, cube: Cube) -> dict[str, Any]:
    """The map's figures as JSON's values."""
    total = max(finding.looked_at, 1)
    return {
        "rows": cube.rows,
        "columns": cube.columns,
        "looked_at": finding.looked_at,
        "scale": cube.scale,
        "bands_left_out": list(cube.left_out),
        "codes": [
            {"code": code, "name": name, "pixels": pixels, "share": None if code == NOT_LOOKED_AT else pixels /
            total} for code, name in enumerate(finding.names)
            for pixels in [finding.pixels_of(code)]
        ],
        "regions": [
            {
                "number": region.number, "code": region.code, "verdict": region.finding.verdict,
                "class": region.finding.class_name, "pixels": region.pixels, "share": region.share,
                "probability": region.finding.candidates[0].probability,
                "not_in_library": region.finding.not_in_library, "agreement": region.agreement,
                "draws_alike": region.draws_alike,
            }
            for region in finding.regions
        ],
    }  # fmt: skip


def _spectra(finding: ImageFinding, cube: Cube) -> str:
    """Wavelengths in rows; mean and standard deviation of each region in columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [f"{quantity} {region.number}" for region in finding.regions for quantity in ("mean", "deviation")]
    writer.writerow(["nm", *heads])
    columns = [values for region in finding.regions for values in (region.mean, region.deviation)]
    for row, nm in enumerate(cube.wavelengths_nm):
        writer.writerow([f"{nm:g}", *(f"{values[row]:.6f}" for values in columns)])
    return text.getvalue()
