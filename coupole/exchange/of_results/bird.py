"""The metrologists' Universal BRDF data format (EMPIR project BiRD, 16NRM08, schema 1.0 of 2021), JSON: measured
samples of triangles, with standard uncertainties.

The schema has wavelengths, but no channels of a camera; therefore there is one file for each channel.
"""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.of_results.material_tables import chosen_triangles
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.exchange.of_results.triangle_samples import SamplesOfTriangle, channels_of, samples_of
from coupole.reflectance.run_result import ABOUT
from coupole.storage.durable import sha256, write_synced

SCHEMA = (
    "https://raw.githubusercontent.com/BiRD-project/BiRD_view/master/BRDF_JSON_schema/brdf_json_schema_v1.0.json"
)
_DECIMALS = 6
"""Decimals of angles in degrees."""
_NOT_SAID = "NA"
"""Word of the format for a fact that is not given."""
_NOBODY = "not-stated@example.invalid"
"""Placeholder, because the schema demands an address."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `triangleN_red.brdf` and so on (`_grey` for a sensor without filter).

    The columns are theta_i, phi_i of the light, theta_r, phi_r of the camera (degrees, about the mesh's normal),
    BRDF and uBRDF (1/sr). Two kinds of samples are left out, and counted in the comments: samples that noise made
    negative, which the schema does not allow, and samples with an open upper bound.
    """
    paths = []
    for triangle in chosen_triangles(surface):
        samples = samples_of(surface, int(triangle), 1.0)
        for number, channel in enumerate(channels_of(surface)):
            paths.append(folder / f"triangle{triangle}_{channel}.brdf")
            document = {
                "metadata": _metadata(surface, int(triangle), channel),
                "data": _data(samples, number),
            }
            write_synced(paths[-1], json.dumps(document, indent=1) + "\n")
    return paths


def _data(samples: SamplesOfTriangle, channel: int) -> dict[str, Any]:
    f, high, low = samples.f[:, channel], samples.high[:, channel], samples.low[:, channel]
    is_finite = np.isfinite(f)
    is_usable = is_finite & (f >= 0.0) & np.isfinite(high)
    u = np.maximum(high - 1.0, 1.0 - low)[is_usable] * f[is_usable]
    theta_i, phi_i = _polar(samples.towards_light[is_usable])
    theta_r, phi_r = _polar(samples.towards_camera[is_usable])
    angles = {"theta_i": theta_i, "phi_i": phi_i, "theta_r": theta_r, "phi_r": phi_r}
    negative, open_ended = (
        int((is_finite & (f < 0.0)).sum()),
        int((is_finite & (f >= 0.0) & ~np.isfinite(high)).sum()),
    )
    left_out = f"left out: {negative} samples below 0, {open_ended} without an upper bound"
    return {
        **{name: {"unit": "deg", "values": values.tolist()} for name, values in angles.items()},
        "BRDF": {"unit": "1/sr", "values": f[is_usable].tolist(), "comments": left_out},
        "uBRDF": {
            "unit": "1/sr",
            "values": u.tolist(),
            "comments": "standard uncertainty (k = 1), all parts together; the wider side of the interval",
        },
    }


def _polar(ways: Floats) -> tuple[NDArray[Any], NDArray[Any]]:
    """[n] zenith angle, and azimuth from 0 to below 360, degrees."""
    theta = np.degrees(np.arccos(np.clip(ways[:, 2], -1.0, 1.0)))
    phi = np.degrees(np.arctan2(ways[:, 1], ways[:, 0])) % 360.0
    return np.asarray(np.round(theta, _DECIMALS)), np.asarray(np.round(phi, _DECIMALS) % 360.0)


def _metadata(surface: MeasuredSurface, triangle: int, channel: str) -> dict[str, Any]:
    about, path = surface.about, surface.result.folder / ABOUT
    timestamp = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
    name = f"{sha256(path)} triangle {triangle} {channel}"
    nowhere = dict.fromkeys(("country", "city", "street", "building_nr", "postal_code"), _NOT_SAID)
    area = {"value": float(surface.result.areas_mm2[triangle]), "unit": "mm^2"}
    is_simulated = bool(about.get("simulated"))
    return {
        "schema": SCHEMA,
        "id": f"urn:sha256:{hashlib.sha256(name.encode()).hexdigest()}",
        "type": "BRDF",
        "timestamp": timestamp,
        "provenance": {
            "organization": _NOT_SAID,
            "location": nowhere,
            "email": _NOBODY,
            "contact_person": _NOT_SAID,
            "comments": "to be filled in by the publisher of this file",
        },
        "description": f"Triangle {triangle} of a scanned object, the camera's {channel}; {surface.remark}",
        "method": "simulation" if is_simulated else "measurement",
        "instrumentation": _NOT_SAID,
        "software": {"name": "Coupole", "version": about["software"]["coupole"]},
        "sample": {
            "name": f"{', '.join(sorted(about['runs']))}: triangle {triangle}",
            "type": "part of an object's surface",
            "shape": "triangle of the object's mesh",
            "dimensions": {"area": area},
            "zero_azimuth_location": "along the support's x axis, projected onto the triangle; y is 90 degrees",
        },
        "environment": _NOT_SAID,
        "comments": f"White LEDs of a dome and a colour camera: {channel} is a broad band, not a wavelength.",
    }
