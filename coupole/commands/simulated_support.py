"""Things on a simulated cell's support for a calibration: a copy of the rig with these things, and their
descriptions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coupole.errors import InputError

BOARD = """\
schema_version: 1
kind: charuco
corners: [11, 8]
square_mm: 16.0
marker_mm: 9.6
dictionary: DICT_5X5_250
"""
TILE = """\
schema_version: 1
side_mm: 50.0
support_from_tile: {translation_mm: [0, 0, 10]}
"""
GLARE_TARGET = """\
schema_version: 1
name: simulated card with nine black traps
trap_share: 0.0003
u_trap_share: 0.0002
"""
CERTIFICATE_OF_SIMULATED_TILE = "minnaert: 1.0\n"
_DESCRIPTIONS = {
    "charuco": ("board", BOARD),
    "glare": ("target", GLARE_TARGET),
    "spectralon": ("tile", TILE + CERTIFICATE_OF_SIMULATED_TILE),
}


def with_things(rig_path: Path, things: Sequence[Mapping[str, Any]], path: Path, runs: Path | None = None) -> None:
    """Write a copy of a simulated cell's rig with more things on the support; its paths are absolute, and its runs
    go to `runs` if that is given. Raises InputError."""
    from ruamel.yaml import YAML

    from coupole.plan import yamlfile
    from coupole.plan.rewriting import named_paths, rewritten
    from coupole.plan.rig import Rig

    document = yamlfile.read_document(rig_path)
    entries = [(at, value) for at, value in named_paths(document.validate(Rig)) if at in document.value_places]
    changes = {at: str(document.resolve(value)) for at, value in entries}
    yaml = YAML()
    yaml.width = 4096
    content = yaml.load(rewritten(document, document.text, changes))
    if runs is not None:
        content["storage"]["folder"] = str(runs)
    settings = content["world"].setdefault("settings", {})
    settings["things"] = [*settings.get("things", ()), *(dict(thing) for thing in things)]
    try:
        with path.open("x", encoding="utf-8") as file:
            yaml.dump(content, file)
    except FileExistsError as error:
        raise InputError(f"{path}: exists already; choose another name") from error


def place_for(template: str, things: Sequence[Mapping[str, Any]], rig: Path, name: str) -> list[Path]:
    """Write NAME-rig.yaml, the rig with the things that a template's plan photographs, and their description for
    `coupole calibrate`. Returns what was written. Raises InputError if one of them exists."""
    paths = [Path(f"{name}-rig.yaml")]
    with_things(rig, things, paths[0])
    if template in _DESCRIPTIONS:
        kind, text = _DESCRIPTIONS[template]
        paths.append(Path(f"{name}-{kind}.yaml"))
        if paths[-1].exists():
            raise InputError(f"{paths[-1]}: exists already; choose another name")
        paths[-1].write_text(text, encoding="utf-8")
    return paths
