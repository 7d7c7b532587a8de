"""What every test shares: no display, reproducible hypothesis, and who may lack dolfinx."""

from __future__ import annotations

import gc
import importlib.util
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NoReturn

import matplotlib
import psutil
import pytest
from hypothesis import HealthCheck, settings

matplotlib.use("Agg")

with suppress(ImportError):  # versions of hypothesis that know nothing of it
    from hypothesis.internal.conjecture import providers
    from hypothesis.internal.constants_ast import Constants

    # It would try numbers from the source of all modules that a process has imported: examples
    # would depend on the tests that the process ran before.
    providers._get_local_constants = Constants

settings.register_profile(
    "modeharvest",
    derandomize=True,  # the same examples everywhere: a failure is the code's, not the seed's
    deadline=None,  # the first example compiles kernels
    max_examples=25,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("modeharvest")

FILES_THAT_TAKE_LONG = (
    "test_site.py",
    "test_identification_run.py",
    "test_disturbed.py",
    "test_pipeline.py",
    "test_homogenization_run.py",
    "test_fem_homogenization.py",
    "test_harvest_whole_field.py",
    "test_damaged_files.py",
    "test_campaign.py",
    "test_measure.py",
    "test_studies.py",
    "test_lattice_pipeline.py",
    "test_fem_bloch.py",
    "test_fem_simulate.py",
    "test_lattice_symmetry.py",
    "test_whole_measure.py",
    "test_weighting.py",
    "test_harvest_patterns.py",
    "test_harvest_pipeline.py",
    "test_error_bars.py",
    "test_fem_stackings.py",
    "test_correlate_noise.py",
    "test_fem_postbuckling.py",
    "test_harvest_sequence.py",
)
"""They come first where several processes share out the files, or one would end long after all."""

WHY_SKIPPED = "needs dolfinx >= 0.9; `scripts/env python -m pytest` provides it"


class _ModuleThatNeedsDolfinx(pytest.Module):
    """Stands in for a test file that can't be imported here, so that its absence is seen."""

    def collect(self) -> NoReturn:
        pytest.skip(WHY_SKIPPED, allow_module_level=True)


def _dolfinx_is_missing() -> bool:
    """Whether to skip; never under `scripts/env`, where a missing dolfinx is a failure."""
    required = os.environ.get("MODEHARVEST_REQUIRE_DOLFINX") == "1"
    return not required and importlib.util.find_spec("dolfinx") is None


@pytest.fixture(scope="session", autouse=True)
def _no_power_failure() -> Iterator[None]:
    """Let files reach the disk when they like: what tests kill is processes, not the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module")
def coarse_pictures() -> Iterator[None]:
    """Draw the fields of reports with few pixels, where a test is not about its pictures."""
    from modeharvest.report.figures import style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "DPI", 65)
        yield


@pytest.fixture
def unrendered_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose the figures of reports, but leave out their SVG, where a test is not about them.

    What a module's fixtures have made before is whole.
    """
    from modeharvest.report.figures import style

    monkeypatch.setattr(style, "to_svg", lambda *_, **__: "<svg></svg>")


@pytest.fixture
def undrawn_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures of reports out, where a test is not about them and others compose them."""
    from modeharvest.report.model import output
    from modeharvest.report.model.content import ReportFigure
    from modeharvest.util.progress import Progress, counted, silent

    def blank(figures: Iterable[ReportFigure], progress: Progress = silent) -> dict[str, str]:
        return {f.name: "<svg></svg>" for f in counted(list(figures), progress, "report")}

    monkeypatch.setattr(output, "draw_figures", blank)


def pytest_configure(config: pytest.Config) -> None:
    """One thread for kernels where several processes share out the tests, file by file."""
    config.option.loadscopereorder = False  # many tests in a file don't mean that it takes long
    if hasattr(config, "workerinput"):
        import numba

        numba.set_num_threads(1)
        gc.disable()  # until all tests are imported


_compiling = pytest.StashKey[list[int]]()
_until_finished = ExitStack()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what most tests need once for several processes, or each compiles all of it."""
    if session.config.getoption("numprocesses", None):
        from modeharvest.runs.precompile import precompiling

        stages = "image", "correlate", "measure"
        children = _until_finished.enter_context(precompiling(stages)).children.values()
        session.config.stash[_compiling] = [child.pid for child in children]


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a process that does a share of the tests who compiles."""
    node.workerinput["compiling"] = node.config.stash[_compiling]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the files that take long where several processes share them out."""
    if hasattr(config, "workerinput"):
        order = {name: place for place, name in enumerate(FILES_THAT_TAKE_LONG)}
        items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Wait for those who compile; keep what the imports left out of all collections of garbage.

    From now on these are rare: most of what they would look through is matplotlib's, and little.
    """
    for pid in getattr(session.config, "workerinput", {}).get("compiling", ()):
        while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
            time.sleep(0.1)
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Leave no child behind."""
    _until_finished.close()


def pytest_pycollect_makemodule(
    module_path: Path, parent: pytest.Collector
) -> pytest.Module | None:
    """Skip the files ``test_fem_*.py`` as a whole where there is no dolfinx."""
    if module_path.name.startswith("test_fem_") and _dolfinx_is_missing():
        return _ModuleThatNeedsDolfinx.from_parent(parent, path=module_path)
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip single tests with the marker ``dolfinx`` likewise."""
    if item.get_closest_marker("dolfinx") and _dolfinx_is_missing():
        pytest.skip(WHY_SKIPPED)
