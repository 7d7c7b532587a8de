"""The report of an infinite lattice: one page like the paper's Figs. "modes" and "graded"."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from modeharvest.fem.materials import material_in_words
from modeharvest.files import atomic
from modeharvest.idic.families.lattice_spectrum import upward
from modeharvest.progress import Progress, silent
from modeharvest.validation.lattice import words
from modeharvest.validation.lattice.independence import PatternMode
from modeharvest.validation.lattice.patch import Patch
from modeharvest.validation.lattice.plots import draw_growth, draw_lattice, draw_overlay
from modeharvest.validation.lattice.plots_branches import (
    combination_name,
    draw_amplitudes,
    draw_captured,
    draw_critical_strains,
    draw_differences,
    draw_energies,
    draw_overlaps,
)
from modeharvest.validation.lattice.plots_waves import (
    draw_dispersion,
    draw_lattice_spectrum,
    draw_zone_map,
)
from modeharvest.validation.lattice.run import SHAPE, CriticalPoint, FoundPattern, LatticeRun
from modeharvest.validation.page import render, short
from modeharvest.validation.report import Picture
from modeharvest.validation.style import to_svg

__all__ = ["CriticalPoint", "FoundPattern", "LatticeRun", "write_lattice_report"]

TEMPLATE = "lattice.html"
WORDS = {
    "percent": words.percent,
    "key_numbers": words.key_numbers,
    "branch_rows": words.branch_rows,
    "study_sentences": words.study_sentences,
    "study_rows": words.study_rows,
    "notes": words.notes,
    "waves_in_words": words.waves_in_words,
    "proof": words.proof,
}
"""What the template calls by name."""
CELLS = 4
"""Unit cells along the side of a picture's window."""
VISIBLE = 0.12
"""Largest fluctuation that a deformed lattice is drawn with, at least [l]."""


def write_lattice_report(path: Path | str, run: LatticeRun, progress: Progress = silent) -> None:
    """Write the report of a lattice, atomically.

    Parameters
    ----------
    path
        The HTML file.
    run
        What it shows.
    progress
        Listener.
    """
    parts = [_hero, _reference, _patterns, _dispersion, _modes, _branches, _study]
    content: dict[str, Any] = {}
    for n, part in enumerate(parts):
        progress(n, len(parts), "report")
        content[part.__name__.removeprefix("_")] = part(run)
    material = material_in_words(run.case["material"])
    page = render(TEMPLATE, title=run.title, run=run, words=WORDS, material=material, **content)
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _picture(name: str, label: str, drawn: Figure, fact: str = "") -> Picture:
    return Picture(name, label, to_svg(drawn, name, label), fact)


def _window(run: LatticeRun, width: float, height: float) -> Patch:
    """Cells of the modes where there are some, primitive ones otherwise [l]."""
    mesh, lattice = run.mesh, run.lattice
    if run.modes is not None:
        mesh, lattice = run.modes.mesh, run.modes.lattice
    return Patch.of(mesh, lattice, (width * run.pitch, height * run.pitch))


def _hero(run: LatticeRun) -> str:
    if run.modes is None:
        drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch)
    else:
        shape, patterns = run.modes.shapes[0], run.patterns
        if patterns:
            shown = next((p for p in patterns if p.stable), patterns[0])
            shape = shown.fluctuation(run.modes.mesh.nodes)
        drawn = draw_growth(_window(run, 7.0, 5.6), shape, SHAPE * run.pitch, run.pitch)
    return to_svg(drawn, "hero", "The lattice and its pattern")


def _reference(run: LatticeRun) -> Picture:
    drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch)
    return _picture("reference", "Reference", drawn, "dashed: the cell that repeats")


def _patterns(run: LatticeRun) -> list[dict[str, Any]]:
    """For each pattern the deformed lattice and both densities, and its family."""
    return [
        {"found": found, "waves": found.family.waves,
         "pictures": [_deformed(run, found, n), *_densities(found, n)]}
        for n, found in enumerate(run.patterns, start=1)
    ]  # fmt: skip


def _deformed(run: LatticeRun, found: FoundPattern, n: int) -> Picture:
    """The deformed lattice; a fluctuation that is too small to be seen is magnified."""
    assert run.modes is not None
    nodes = run.modes.mesh.nodes
    fluctuation = found.fluctuation(nodes)
    largest = float(np.linalg.norm(fluctuation, axis=1).max()) / run.pitch
    factor = SHAPE / largest if found.stable is None else max(1.0, VISIBLE / largest)
    u = found.displacement + (factor - 1.0) * fluctuation
    drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch, u, found.gradient)
    if found.stable is None:
        fact = f"a mode, no equilibrium; largest displacement {SHAPE} l"
    else:
        fact = "stable; " if found.stable else "unstable; "
        fact += f"fluctuation × {factor:.3g}" if factor > 1.005 else "true to scale"
    return _picture(f"deformed-{n}", "Deformed", drawn, fact)


def _densities(found: FoundPattern, n: int) -> list[Picture]:
    spectrum = found.spectrum
    both = {"xx": spectrum.S_xx, "yy": spectrum.S_yy}
    largest = float(max(S.max() for S in both.values()))
    pictures = []
    for name, S in both.items():
        up = np.where(upward(spectrum.xi), S, 0.0)
        xi = [float(x) for x in spectrum.xi[int(np.argmax(up))]]
        of = "" if found.stable is None else f" {short(float(S.max()))} mm⁶"  # a mode has no size
        fact = f"largest{of} at ±({short(xi[0])}, {short(xi[1])})"
        svg = to_svg(draw_lattice_spectrum(spectrum.xi, S, largest), f"S{name}-{n}", f"S_{name}")
        pictures.append(Picture(f"S{name}-{n}", Markup(f"S<sub>{name}</sub>"), svg, fact))
    return pictures


def _dispersion(run: LatticeRun) -> dict[str, Any]:
    """The path's curves and the zone's maps."""
    found = run.dispersion
    if found is None:
        return {}
    waves = [wave for point in run.critical for wave in point.waves]
    return {
        "path": _picture("dispersion-path", "Along a path", draw_dispersion(found, waves)),
        "maps": [
            _picture(f"zone-{n}", f"At {100 * part.load:.4g} %",
                     draw_zone_map(part, run.pitch, waves))
            for n, part in enumerate(found.zone, start=1)
        ],
    }  # fmt: skip


def _modes(run: LatticeRun) -> list[Picture]:
    """Every mode of the set upon the undeformed lattice."""
    modes = run.modes
    if modes is None:
        return []
    still, pictures = _window(run, CELLS, CELLS), []
    for k, (wave, value) in enumerate(zip(modes.waves, modes.eigenvalues, strict=True)):
        shape = modes.shapes[k]
        u = SHAPE * run.pitch / float(np.linalg.norm(shape, axis=1).max()) * shape
        name = combination_name([float(j == k) for j in range(len(modes.waves))])
        label = f"{name} · wave {words.wave_name(wave)}"
        fact = f"eigenvalue {short(float(value))} N/mm⁴"
        pictures.append(_picture(f"mode-{k + 1}", label, draw_lattice(still, run.pitch, u), fact))
    return pictures


def _branches(run: LatticeRun) -> list[Picture]:
    followed = [branch for branch in run.branches if branch.states]
    if not followed or run.modes is None:
        return []
    critical = run.modes.load
    return [
        _picture("energies", "Energy", draw_energies(followed, critical)),
        _picture("amplitudes", "Amplitude", draw_amplitudes(followed, critical)),
        *([_picture("differences", "Which one is lowest", draw_differences(followed))]
          if len(followed) > 1 else []),
    ]  # fmt: skip


def _study(run: LatticeRun) -> dict[str, Any]:
    """Curves and overlays of a study."""
    study = run.study
    if study is None:
        return {}
    curves = [
        _picture("strains", "Critical strain", draw_critical_strains(study.ratios)),
        _picture("overlaps", "Overlap with Eq. (mode)", draw_overlaps(study.ratios)),
        _picture("captured", "Energy captured", draw_captured(study.ratios)),
    ]
    overlays = [_overlay(mode, n) for n, mode in enumerate(study.overlays, start=1)]
    return {"curves": curves if study.ratios else [], "overlays": overlays}


def _overlay(mode: PatternMode, n: int) -> Picture:
    """Both modes on one cell, less enlarged where small holes would close."""
    row = mode.row
    size = min(SHAPE, 0.4 * row.ratio)
    drawn = draw_overlay(mode.mesh, row.pitch, mode.shape, mode.analytic, size * row.pitch)
    fact = f"overlap {row.overlap:.4f}; largest displacement {size:.3g} l; {row.loading}, state at "
    fact += f"{100 * row.state:.4g} %" + ("" if row.is_first else ", where it is not critical")
    return _picture(f"overlay-{n}", f"d/l = {row.ratio:.4g}", drawn, fact)
