"""A run or a result as a research object crate (RO-Crate 1.1): its files, with `ro-crate-metadata.json` beside
them.

This file states in JSON-LD what the files are, who owns them, and from what and by what they were made.
"""

from __future__ import annotations

import contextlib
import json
import mimetypes
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from coupole.errors import InputError
from coupole.exchange.formats import RESTORATION_RESULT, Source, source_of
from coupole.exchange.target_folder import writing_into
from coupole.intake.plain_data import read_json
from coupole.reflectance.run_result import ABOUT, read_about
from coupole.storage.durable import sha256, write_synced
from coupole.storage.run import Run

METADATA = "ro-crate-metadata.json"
DATA = "data"
"""Folder of the files, unless they are described in place."""
_SPECIFICATION = "https://w3id.org/ro/crate/1.1"
_ORCID = re.compile(r"https://orcid\.org/\d{4}-\d{4}-\d{4}-\d{3}[\dX]")
_TOLD = {
    ".h5": "HDF5",
    ".yaml": "application/yaml",
    ".jsonl": "application/jsonl",
    ".ply": "application/octet-stream",
    ".sha256": "text/plain",
}
_LINKED = ".h5"
_ACTIONS = {
    "run": "acquisition",
    "result": "measurement of reflectance",
    "restoration": "virtual restoration",
}
Entity = dict[str, Any]


@dataclass(frozen=True)
class CrateFacts:
    """Facts that only the authors of a crate can state."""

    licence: str | None = None
    """URL or text of the licence; None for the licence in the run's plan."""
    authors: tuple[str, ...] = ()
    """The authors, each as `NAME <https://orcid.org/...> at INSTITUTION`, or a name alone."""
    publisher: str | None = None
    name: str | None = None
    """Title; None for the folder's name."""
    identifier: str | None = None
    """An identifier such as a DOI."""


def write_crate(
    source: Path,
    out: Path,
    facts: CrateFacts,
    *,
    in_place: bool,
    overwrite: bool,
    say: Callable[[str, int, int], None],
) -> list[Path]:
    """Write the crate into `out`, with its files below `data/`.

    Files are copied. Frames and samples (HDF5) are hard links where the file system allows them. With `in_place`,
    only the metadata is written, into `source`. With `overwrite`, the files of a crate in `out` are removed first;
    all other files are kept.

    Raises InputError if no licence or author is known, if one is named twice, if the run is being acquired, if
    `out` contains the source, or if `out` has files (unless `overwrite`); DiskFull or StorageError.
    """
    origin = _source_facts(source)
    licence = facts.licence or origin.get("licence")
    if not licence:
        raise InputError(
            "--licence: RO-Crate requires a licence, and the plan names none; give its URL or its text"
        )
    if not facts.authors:
        raise InputError(
            "--author: expected at least one, 'NAME <https://orcid.org/...> at INSTITUTION' or a name"
        )
    people = _people(facts.authors)
    root = source if in_place else out
    if not in_place and source.resolve().is_relative_to(root.resolve()):
        raise InputError(f"{root}: holds SOURCE. Choose another --out, or give --in-place")
    if not overwrite and ((root / METADATA).exists() or (not in_place and root.is_dir() and any(root.iterdir()))):
        raise InputError(f"{root}: has files already. Choose another --out, or give --overwrite")
    if not in_place and (root / DATA).exists() and not (root / METADATA).exists():
        raise InputError(
            f"{root / DATA}: belongs to no crate, because {METADATA} is missing. Remove it, or choose another "
            "--out"
        )
    inside = "" if in_place else f"{DATA}/"
    paths = sorted(_files(source, without=None if in_place else root))
    files, links = [], []
    with writing_into(root):
        if not in_place and (root / DATA).exists():
            shutil.rmtree(root / DATA)
        for number, path in enumerate(paths):
            inner = path.relative_to(source).as_posix()
            files.append(_file_entity(path, f"{inside}{inner}"))
            if not in_place:
                links.append(root / DATA / inner)
                _take(path, links[-1])
            say("files", number + 1, len(paths))
        graph = [*_entities(source, origin, licence, facts, people, files)]
        document = {"@context": f"{_SPECIFICATION}/context", "@graph": graph}
        write_synced(root / METADATA, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return [root / METADATA, *links]


def _source_facts(source: Path) -> dict[str, Any]:
    """Return kind, time, software and inputs of the source."""
    if source_of(source) is Source.RESTORATION:
        return _restoration_facts(source)
    if (source / ABOUT).exists():
        about = read_about(source)
        timestamp = datetime.fromtimestamp((source / ABOUT).stat().st_mtime, UTC).isoformat(timespec="seconds")
        runs = about["runs"]
        return {
            "kind": "result",
            "ended": timestamp,
            "nature": _nature(is_simulated=bool(about.get("simulated"))),
            "software": about["software"],
            "inputs": {name: digest for files in runs.values() for name, digest in files.items()},
            "told": f"Reflectance of the surface of an object, from {', '.join(sorted(runs))}",
        }
    run = Run(source)
    if run.in_use:
        raise InputError(f"{source}: another process is acquiring into this run; wait until it ends")
    return {
        "kind": "run",
        "ended": run.about["created"],
        "nature": _nature(is_simulated=run.is_simulated),
        "software": {run.about["software"]["name"]: run.about["software"]["version"]},
        "inputs": {},
        "licence": run.about.get("licence"),
        "told": f"Photographs of {run.about.get('object') or 'an object without a name'} under single lights of "
        f"the dome La Coupole; frames are proven by: {run.proof}",
        "devices": run.about.get("devices") or {},
    }


def _nature(*, is_simulated: bool) -> str:
    return "simulated, no real object or light" if is_simulated else "measured"


def _restoration_facts(source: Path) -> dict[str, Any]:
    """Return the facts of a restoration. Raises InputError if its result.json is not from `coupole restore`."""
    result = read_json(source / RESTORATION_RESULT, allow_nan=True)
    if not isinstance(result, dict) or not {"restoration", "hypotheses", "software", "mesh"} <= result.keys():
        raise InputError(f"{source / RESTORATION_RESULT}: expected what `coupole restore` writes; restore again")
    name, _, version = str(result["software"]).partition(" ")
    titles = "; ".join(str(hypothesis["title"]) for hypothesis in result["hypotheses"])
    timestamp = datetime.fromtimestamp((source / RESTORATION_RESULT).stat().st_mtime, UTC)
    return {
        "kind": "restoration",
        "ended": timestamp.isoformat(timespec="seconds"),
        "nature": "computed, not measured",
        "software": {name: version},
        "inputs": {str(result["mesh"]["name"]): str(result["mesh"]["sha256_of_shape"])},
        "told": f"Hypotheses of how {result['restoration']} may have looked: {titles}",
    }


def _files(source: Path, without: Path | None) -> Iterator[Path]:
    for path in source.rglob("*"):
        inner = path.relative_to(source)
        is_hidden = any(part.startswith(".") for part in inner.parts)
        if not path.is_file() or is_hidden or inner.as_posix() == METADATA:
            continue
        if without is None or not path.resolve().is_relative_to(without.resolve()):
            yield path


def _entities(
    source: Path,
    source_facts: dict[str, Any],
    licence: str,
    facts: CrateFacts,
    people: Sequence[tuple[Entity, Entity | None]],
    files: Sequence[Entity],
) -> Iterator[Entity]:
    authors = [person for person, _ in people]
    houses = {house["@id"]: house for _, house in people if house is not None}
    softwares = [_software(name, version) for name, version in source_facts["software"].items()]
    inputs = [
        {"@id": f"#input-{digest[:16]}", "@type": "CreativeWork", "name": name, "identifier": f"sha256:{digest}"}
        for name, digest in source_facts["inputs"].items()
    ]
    terms = _licence(licence)
    root: Entity = {
        "@id": "./",
        "@type": "Dataset",
        "name": facts.name or source.resolve().name,
        "description": f"{source_facts['told']} ({source_facts['nature']}).",
        "datePublished": datetime.now(UTC).date().isoformat(),
        "license": _to(terms),
        "author": _to_all(authors),
        "hasPart": _to_all(files),
        "mentions": {"@id": "#made"},
    }
    if facts.identifier:
        root["identifier"] = facts.identifier
    yield {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": _SPECIFICATION},
        "about": {"@id": "./"},
    }
    if facts.publisher:
        publisher = _organisation(facts.publisher)
        houses[publisher["@id"]] = publisher
        root["publisher"] = _to(publisher)
    action: Entity = {
        "@id": "#made",
        "@type": "CreateAction",
        "name": _ACTIONS[source_facts["kind"]],
        "startTime" if source_facts["kind"] == "run" else "endTime": source_facts["ended"],
        "result": {"@id": "./"},
    }
    devices = [
        {
            "@id": f"#device-{role}",
            "@type": "Product",
            "name": f"{role}: {device.get('vendor', '')} {device['model']}".strip(),
            "identifier": str(device["serial"]),
        }
        for role, device in source_facts.get("devices", {}).items()
    ]
    action["instrument"] = _to_all([*softwares, *devices])
    if inputs:
        action["object"] = _to_all(inputs)
    yield from (root, *authors, *houses.values(), terms, *softwares, *devices, *inputs, action, *files)


def _file_entity(path: Path, inner: str) -> Entity:
    media_type = _TOLD.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return {
        "@id": quote(inner),
        "@type": "File",
        "name": Path(inner).name,
        "encodingFormat": "application/x-hdf5" if media_type == "HDF5" else media_type,
        "contentSize": str(path.stat().st_size),
        "identifier": f"sha256:{sha256(path)}",
    }


def _people(texts: Sequence[str]) -> list[tuple[Entity, Entity | None]]:
    people = [_person(text) for text in texts]
    ids = [person["@id"] for person, _ in people]
    if twice := [identifier for identifier in ids if ids.count(identifier) > 1]:
        raise InputError(f"--author: {twice[0]} is named twice; give an ORCID where names are alike")
    return people


def _person(text: str) -> tuple[Entity, Entity | None]:
    """Return an author and the author's institution."""
    author, _, house = map(str.strip, text.partition(" at "))
    name, _, within = map(str.strip, author.partition("<"))
    url = within.removesuffix(">")
    if not name or (within and not _ORCID.fullmatch(url)):
        raise InputError(
            f"--author {text!r}: expected 'NAME', 'NAME <https://orcid.org/0000-0000-0000-0000>', followed by ' "
            "at INSTITUTION' if you want to name the institution"
        )
    person = {"@id": url or f"#person-{_part_of_id(name)}", "@type": "Person", "name": name}
    if not house:
        return person, None
    organisation = _organisation(house)
    return {**person, "affiliation": _to(organisation)}, organisation


def _organisation(name: str) -> Entity:
    return {"@id": f"#organisation-{_part_of_id(name)}", "@type": "Organization", "name": name}


def _part_of_id(name: str) -> str:
    """Encode a name as a part of a URI; different names give different ids."""
    return quote(name, safe="")


def _licence(text: str) -> Entity:
    if text.startswith(("https://", "http://")):
        return {"@id": text, "@type": "CreativeWork", "name": text}
    return {"@id": "#licence", "@type": "CreativeWork", "name": text, "description": f"Terms of use: {text}"}


def _software(name: str, version: str) -> Entity:
    identifier = f"#software-{_part_of_id(name)}"
    return {"@id": identifier, "@type": "SoftwareApplication", "name": name, "version": version}


def _to(entity: Entity) -> Entity:
    return {"@id": entity["@id"]}


def _to_all(entities: Sequence[Entity]) -> Entity | list[Entity]:
    """Return a list, or the entity itself if there is only one, as the specification demands."""
    return _to(entities[0]) if len(entities) == 1 else [_to(entity) for entity in entities]


def _take(path: Path, to: Path) -> None:
    """Hard-link a file that is large and never rewritten; copy others, because commands may rewrite them in
    place."""
    to.parent.mkdir(parents=True, exist_ok=True)
    to.unlink(missing_ok=True)
    if path.suffix == _LINKED:
        with contextlib.suppress(OSError):
            os.link(path, to)
            return
    shutil.copy2(path, to)
