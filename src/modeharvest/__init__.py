"""A virtual laboratory for integrated DIC on mechanical metamaterials.

``fem`` (the exact displacement), ``imaging`` (speckle images of it), ``idic`` (measure those
images) and ``validation`` (how large the errors are) are used from left to right; ``runs`` joins
them, ``report`` shows what they found, ``cli`` is the command line.

What most scripts need is here, each name loaded when it is first used::

    import modeharvest as mh
    solution = mh.simulate(mh.Experiment(strains=(0.078, 0.128)))
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # typing's own takes longer to import than everything here
if TYPE_CHECKING:  # what type checkers and editors see of the table below
    from typing import Any

    from modeharvest.fem.experiment import Experiment
    from modeharvest.fem.field import Solution
    from modeharvest.fem.materials import Ogden
    from modeharvest.fem.simulate import simulate
    from modeharvest.fem.specimen import Specimen
    from modeharvest.idic.ansatz import Ansatz
    from modeharvest.idic.correlate import best_fit, correlate
    from modeharvest.idic.result import Result
    from modeharvest.imaging.imageset import make_images
    from modeharvest.imaging.pair import ImagePair
    from modeharvest.imaging.spec import ImagingSpec
    from modeharvest.runs import run
    from modeharvest.runs.benchmark import score
    from modeharvest.runs.case import shipped_solution
    from modeharvest.runs.photographs.pipeline import harvest

    __version__: str

__all__ = [
    "Ansatz", "Experiment", "ImagePair", "ImagingSpec", "Ogden", "Result", "Solution", "Specimen",
    "__version__", "best_fit", "correlate", "harvest", "make_images", "run", "score",
    "shipped_solution", "simulate",
]  # fmt: skip

_HOMES = {
    "Ansatz": "idic.ansatz", "Experiment": "fem.experiment", "ImagePair": "imaging.pair",
    "ImagingSpec": "imaging.spec", "Ogden": "fem.materials", "Result": "idic.result",
    "Solution": "fem.field", "Specimen": "fem.specimen", "best_fit": "idic.correlate",
    "correlate": "idic.correlate", "harvest": "runs.photographs.pipeline",
    "make_images": "imaging.imageset", "run": "runs", "score": "runs.benchmark",
    "shipped_solution": "runs.case", "simulate": "fem.simulate",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Load a public name from its module when it is first used."""
    if name == "__version__":  # git may have to be asked
        from modeharvest.util import version

        return version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{_HOMES[name]}")
    except ModuleNotFoundError as error:
        if name == "simulate":
            from modeharvest.util.errors import dolfinx_missing

            raise dolfinx_missing("simulate needs") from error
        raise
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
