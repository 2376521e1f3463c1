"""Values that the shell completes: formats, fits, templates, plans and runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

_PLAN_SAYS, _FIRST_BYTES = "views:", 65536


def formats(incomplete: str) -> list[tuple[str, str]]:
    """Formats of `coupole export --to`, with their descriptions."""
    from coupole.exchange.formats import FORMATS

    return [(name, entry.gives) for name, entry in sorted(FORMATS.items()) if name.startswith(incomplete)]


def fits(incomplete: str) -> list[tuple[str, str]]:
    """Fits of `coupole reflectance relight --fit`, with their descriptions."""
    from coupole.reflectance.fits import FITS, RELIT, TEXEL_CLUSTERS, TEXELS

    titles = {name: fit.title for name, fit in FITS.items()} | {
        TEXELS: "GGX of single pixels",
        TEXEL_CLUSTERS: "of clusters of texels",
    }
    return [(name, titles.get(name, "of clusters")) for name in RELIT if name.startswith(incomplete)]


def materials(incomplete: str) -> list[tuple[str, str]]:
    """Fits that `coupole export --fit` and `coupole show --fit` accept."""
    from coupole.reflectance.fits import MATERIALS, OF_TEXELS

    return [(name, title) for name, title in fits(incomplete) if name in (*MATERIALS, *OF_TEXELS)]


def templates(incomplete: str) -> list[str]:
    """Templates of `coupole plan new`."""
    from coupole.plan.templates import LEDS, TEMPLATES

    return _beginning({*TEMPLATES, LEDS}, incomplete)


def supposed_materials(incomplete: str) -> list[str]:
    """Materials of `coupole plan suggest`."""
    return _beginning({"matt", "glossy", "metal", "unknown"}, incomplete)


def mesh_units(incomplete: str) -> list[str]:
    """Units of meshes."""
    return _beginning({"mm", "m", "um"}, incomplete)


def schemas(incomplete: str) -> list[str]:
    """Kinds of files for which `coupole schema` has a schema."""
    return _beginning({"plan", "rig"}, incomplete)


def plans(incomplete: str) -> list[str]:
    """Files that look like plans, and folders that may contain plans."""
    return sorted(
        f"{path}/" if path.is_dir() else str(path)
        for path in _paths(incomplete)
        if path.is_dir() or (path.suffix in (".yaml", ".yml") and _says_views(path))
    )


def runs(incomplete: str) -> list[str]:
    """Folders of runs, and folders that may contain runs."""
    return sorted(
        str(path) if (path / "run.json").exists() else f"{path}/" for path in _paths(incomplete) if path.is_dir()
    )


def _beginning(words: set[str], incomplete: str) -> list[str]:
    return sorted(word for word in words if word.startswith(incomplete))


def _paths(incomplete: str) -> Iterator[Path]:
    folder, _, begins = incomplete.rpartition("/")
    parent = Path(f"{folder}/" if folder or incomplete.startswith("/") else ".")
    try:
        yield from (
            path for path in parent.iterdir() if path.name.startswith(begins) and (begins or path.name[0] != ".")
        )
    except OSError:
        return


def _says_views(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return f"\n{_PLAN_SAYS}".encode() in file.read(_FIRST_BYTES)
    except OSError:
        return False
