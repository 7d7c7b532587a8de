"""Folders shared as RO-Crates: what every file is, its checksum, licence, software and command.

An RO-Crate (https://w3id.org/ro/crate/1.1) is a folder with ``ro-crate-metadata.json``, JSON-LD in
schema.org's vocabulary, which archives such as Zenodo and search engines read.
"""

from __future__ import annotations

import fnmatch
import mimetypes
import os
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from modeharvest.util import RELEASE
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, require_writable, sha256_of, write_json
from modeharvest.util.stages import digest
from modeharvest.validation.scoring.benchmark import SECRETS
from modeharvest.validation.scoring.benchmark import SIDECAR as BENCHMARK

METADATA = "ro-crate-metadata.json"
PROFILE = "https://w3id.org/ro/crate/1.1"
PAPER = "https://doi.org/10.1016/j.ijsolstr.2024.112916"
LICENCES = {
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
}
_TEMPORARY = (".*", "*.part", "*.log", "__pycache__")
_KINDS = {".tif": "image/tiff", ".h5": "application/x-hdf5", ".vtu": "application/xml"}
"""Media types of files that Python's ``mimetypes`` doesn't know, by extension."""
_RUN = "modeharvest run CASE.toml --out DIR, with the table 'case' of summary.json as CASE.toml"
_UNITS = {"mm": "mm", "px": "px", "percent": "%", "N": "N", "MPa": "MPa", "deg": "degree"}


def write_crate(
    folder: Path | str, licence: str = "CC-BY-4.0", author: str = "", name: str = ""
) -> dict[str, Any]:
    """Describe a finished folder in ``ro-crate-metadata.json``; returns its content.

    folder : folder of a benchmark set, a harvest, a study or any other run, which has
        ``benchmark.json`` or ``summary.json``. Hidden files and logs are left out.
    licence : one of :data:`LICENCES`, or a URL; the licence of a set takes precedence.
    author : the author, "Name" or "Name <https://orcid.org/...>".
    name : title; by default that which the folder states.

    Raises InputError if the folder is none of these, or a public set contains files of its truth.
    """
    folder = Path(folder)
    info = _described(folder)
    licence = str(info.get("licence", licence))
    address = LICENCES.get(licence, licence)
    if not address.startswith("https://"):
        known = ", ".join(LICENCES)
        raise InputError(f"expected a licence ({known}) or its https:// address, got {licence!r}")
    require_writable(folder)
    files = [_file(folder, path) for path in _members(folder)]
    software = {"modeharvest": RELEASE, **info.get("versions", {})}
    made = [_software(library, version) for library, version in software.items()]
    title = name or str(info.get("title") or f"Benchmark {info.get('id', folder.name)}")
    units = [*_quantities(info), *_columns(folder / "table.csv")]
    person, _, orcid = author.partition("<")
    at = orcid.strip(" >") or "#author"
    people = [_entity("Person", at, name=person.strip())] if person.strip() else []
    root = {
        **_entity("Dataset", "./", name=title, description=_description(info)),
        "datePublished": _now(),
        "license": {"@id": address},
        "citation": {"@id": PAPER},
        "isAccessibleForFree": True,
        "author": [_to(person) for person in people],
        "hasPart": [_to(file) for file in files],
        "variableMeasured": [_to(unit) for unit in units],
        "mentions": {"@id": "#made"},
    }
    made_by = _RUN if "snapshots" in info else f"made with modeharvest {RELEASE}"
    command = str(info.get("command") or made_by)
    action = _entity("CreateAction", "#made", name=command, description=command)
    action |= {"instrument": [_to(library) for library in made], "result": {"@id": "./"}}
    about = {"conformsTo": {"@id": PROFILE}, "about": {"@id": "./"}}
    content = {
        "@context": [f"{PROFILE}/context", {"sha256": "https://schema.org/sha256"}],
        "@graph": [
            {**_entity("CreativeWork", METADATA), **about},
            root,
            *files,
            *units,
            *people,
            *made,
            action,
            _entity("CreativeWork", address, name=licence),
            _entity("ScholarlyArticle", PAPER, name="S. Maraghechi et al., the method"),
        ],
    }
    write_json(folder / METADATA, content)
    return content


def verify(folder: Path | str) -> list[str]:
    """Faults of a crate, as text: files missing, changed or not listed; a wrong id of a set.

    Raises InputError if the folder has no ``ro-crate-metadata.json`` that can be read.
    """
    folder, path = Path(folder), Path(folder) / METADATA
    if not path.is_file():
        raise InputError(f"expected {METADATA} in {folder}, got none: 'modeharvest share' makes it")
    content = read_json(path)
    try:
        graph = {str(entity["@id"]): entity for entity in content["@graph"]}
        listed = {part["@id"]: graph[part["@id"]] for part in graph["./"]["hasPart"]}
        faults = [fault for name, entry in listed.items() if (fault := _fault(folder, name, entry))]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"expected an RO-Crate written by modeharvest in {folder / METADATA}, got one without "
            f"{error}; make it again with 'modeharvest share'"
        ) from error
    names = {path.relative_to(folder).as_posix() for path in _members(folder)}
    faults += [f"{name}: not listed in {METADATA}" for name in sorted(names - set(listed))]
    if (folder / BENCHMARK).is_file() and "files" in (info := read_json(folder / BENCHMARK)):
        for name, entry in info["files"].items():
            if (folder / name).is_file() and sha256_of(folder / name) != entry["sha256"]:
                faults.append(f"{name}: not the image of {BENCHMARK}")
        if digest(info["files"])[:12] != info["id"]:
            faults.append(f"{BENCHMARK}: the id {info['id']} isn't that of its files")
    return faults


def _fault(folder: Path, name: str, entry: Mapping[str, Any]) -> str:
    """Text on the fault of a listed file, "" if there is none."""
    path = folder / name
    if folder.resolve() not in path.resolve().parents:
        return f"{name}: lies outside the folder"
    if not path.is_file():
        return f"{name}: missing"
    return "" if sha256_of(path) == entry["sha256"] else f"{name}: changed (SHA-256)"


def _described(folder: Path) -> dict[str, Any]:
    """The data that describe a folder; InputError if unfinished, or public with a truth."""
    if (folder / BENCHMARK).is_file():
        info = dict(read_json(folder / BENCHMARK))
        secrets = [p.name for pattern in SECRETS for p in sorted(folder.glob(pattern))]
        if "files" in info and secrets:
            raise InputError(
                f"expected a public folder without truth, got {secrets[0]} in {folder}"
            )
        return info
    if (folder / "summary.json").is_file():
        return dict(read_json(folder / "summary.json"))
    raise InputError(
        f"expected a finished run or a benchmark set in {folder}, got neither summary.json nor "
        f"{BENCHMARK}; give the folder of --out"
    )


def _members(folder: Path) -> Iterator[Path]:
    """The files to share."""
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        hidden = any(fnmatch.fnmatch(part, pattern) for part in parts for pattern in _TEMPORARY)
        if path.is_file() and not hidden and parts != (METADATA,):
            yield path


def _file(folder: Path, path: Path) -> dict[str, Any]:
    known = _KINDS.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    kind, size = known or "application/octet-stream", str(path.stat().st_size)
    at, digits = path.relative_to(folder).as_posix(), sha256_of(path)
    return _entity("File", at, name=path.name, encodingFormat=kind, contentSize=size, sha256=digits)


def _entity(kind: str, at: str, **content: str) -> dict[str, Any]:
    return {"@id": at, "@type": kind, **content}


def _to(entity: Mapping[str, Any]) -> dict[str, str]:
    return {"@id": entity["@id"]}


def _software(name: str, version: object) -> dict[str, Any]:
    url = "https://www.python.org" if name == "python" else f"https://pypi.org/project/{name}"
    return _entity("SoftwareApplication", f"#{name}", name=name, version=str(version), url=url)


def _quantities(info: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Entries for numbers whose names end in their unit."""
    for key, value in info.items():
        unit = _UNITS.get(key.rpartition("_")[2])
        if unit and isinstance(value, (int, float)) and not isinstance(value, bool):
            yield {**_entity("PropertyValue", f"#{key}", name=key, unitText=unit), "value": value}


def _columns(table: Path) -> Iterator[dict[str, Any]]:
    """Entries for columns of a study's table whose names end in their unit."""
    head = table.read_text("utf-8").partition("\n")[0] if table.is_file() else ""
    for name in head.split(","):
        if unit := _UNITS.get(name.rpartition("_")[2]):
            yield _entity("PropertyValue", f"{table.name}#{name}", name=name, unitText=unit)


def _description(info: Mapping[str, Any]) -> str:
    """Description in one paragraph: content, where units are stated, and axes."""
    what = "Speckle images for any DIC code; the true displacements are kept apart."
    if "files" not in info:
        what = str(info.get("question") or "Results of modeharvest, with a report to read.")
    return f"{what} Units stand in the names of columns and keys; x to the right, y up."


def _now() -> str:
    """The current date, or that of SOURCE_DATE_EPOCH if set."""
    seconds = int(os.environ.get("SOURCE_DATE_EPOCH") or time.time())
    return datetime.fromtimestamp(seconds, UTC).date().isoformat()
