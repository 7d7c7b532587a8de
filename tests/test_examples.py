"""The examples run, are the ones the README shows, and give a right number."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.specimen import Specimen
from modeharvest.imaging.spec import ImagingSpec

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "virtual_experiment.py"


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_readme_shows_the_example_and_it_is_short() -> None:
    text = EXAMPLE.read_text("utf-8")
    assert text.rstrip("\n") in (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 40


@pytest.mark.dolfinx
def test_virtual_experiment_on_a_small_specimen(tmp_path: Path) -> None:
    """IDIC can't beat the best possible fit of its own ansatz, and comes near it.

    The bound of 0.35 px at 10 um/px is the paper-sized demo's (independent calculation); it
    scales with the speckle, so it holds in px at any pixel size.
    """
    experiment = Experiment(Specimen(holes_x=4, holes_y=6), strains=(0.08, 0.15), mesh_size=0.35)
    imaging = ImagingSpec(pixel_size=0.025)
    errors = load(EXAMPLE).main(experiment, imaging, tmp_path)
    assert set(errors) == {0.08, 0.15}
    for idic, best in errors.values():
        assert best <= idic
        assert idic**2 - best**2 < 0.35**2
