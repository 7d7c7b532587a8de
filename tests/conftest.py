"""What every test shares: no display, reproducible hypothesis, and who may lack dolfinx."""

from __future__ import annotations

import gc
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import matplotlib
import pytest
from hypothesis import HealthCheck, settings

matplotlib.use("Agg")

settings.register_profile(
    "modeharvest",
    derandomize=True,  # the same examples everywhere: a failure is the code's, not the seed's
    deadline=None,  # the first example compiles kernels
    max_examples=25,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("modeharvest")

WHY_SKIPPED = "needs dolfinx >= 0.9; `scripts/env python -m pytest` provides it"


class _ModuleThatNeedsDolfinx(pytest.Module):
    """Stands in for a test file that can't be imported here, so that its absence is seen."""

    def collect(self) -> NoReturn:
        pytest.skip(WHY_SKIPPED, allow_module_level=True)


def _dolfinx_is_missing() -> bool:
    """Whether to skip; never under `scripts/env`, where a missing dolfinx is a failure."""
    required = os.environ.get("MODEHARVEST_REQUIRE_DOLFINX") == "1"
    return not required and importlib.util.find_spec("dolfinx") is None


@pytest.fixture(scope="module")
def coarse_pictures() -> Iterator[None]:
    """Draw the fields of reports with few pixels, where a test is not about its pictures."""
    from modeharvest.report.figures import style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "DPI", 65)
        yield


def pytest_configure(config: pytest.Config) -> None:
    """One thread for kernels where several processes share out the tests, file by file."""
    config.option.loadscopereorder = False  # many tests in a file don't mean that it takes long
    if hasattr(config, "workerinput"):
        import numba

        numba.set_num_threads(1)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what most tests need before several processes begin, or each compiles all of it."""
    if session.config.getoption("numprocesses", None):
        from modeharvest.runs.precompile import precompiling

        with precompiling(("image", "correlate", "measure")) as kernels:
            for stage in kernels.children:
                kernels.wait(stage)


def pytest_collection_finish() -> None:
    """Keep what the imports left, which is for good, out of every collection of garbage."""
    gc.collect()
    gc.freeze()


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
