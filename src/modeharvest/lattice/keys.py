"""What each stage of a lattice's analysis depends on: with the same key it is not done again."""

from __future__ import annotations

from modeharvest.files import sha256_of
from modeharvest.lattice.case import LatticeCase
from modeharvest.lattice.kinds import FileLattice
from modeharvest.stages import digest, stage_key


def stage_keys(case: LatticeCase) -> dict[str, str]:
    """By stage, the digest of all that its outcome depends on; a cell's own file included."""
    content = case.plain()
    if isinstance(case.lattice, FileLattice):
        content["lattice"]["content"] = sha256_of(case.lattice.path)
    tables = {name: content[name] for name in ("lattice", "material", "loading", "search")}
    critical = stage_key(tables)
    return {
        "critical": critical,
        "dispersion": digest([critical, content["dispersion"]]),
        "modes": digest([critical, content["modes"]]),
        "families": digest([critical, content["modes"], "families"]),
        "study": stage_key([tables, content["study"]]),
    }
