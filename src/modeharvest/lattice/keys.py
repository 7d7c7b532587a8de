"""What each stage of a lattice's analysis depends on: with the same key it is not done again."""

from __future__ import annotations

from modeharvest import __version__
from modeharvest.lattice.case import LatticeCase
from modeharvest.lattice.kinds import FileLattice
from modeharvest.stages import digest, file_digest


def stage_keys(case: LatticeCase) -> dict[str, str]:
    """By stage, the digest of all that its outcome depends on; a cell's own file included."""
    content = case.plain()
    if isinstance(case.lattice, FileLattice):
        content["lattice"]["content"] = file_digest(case.lattice.path)
    tables = {name: content[name] for name in ("lattice", "material", "loading", "search")}
    critical = digest([tables, __version__])
    return {
        "critical": critical,
        "dispersion": digest([critical, content["dispersion"]]),
        "modes": digest([critical, content["modes"]]),
        "families": digest([critical, content["modes"], "families"]),
        "study": digest([tables, content["study"], __version__]),
    }
