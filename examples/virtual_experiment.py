"""The paper's virtual experiment in Python: simulate, image, correlate, compare."""

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.simulate import simulate
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.spec import ImagingSpec

EXPERIMENT = Experiment(strains=(0.078, 0.128), mesh_size=0.2)
IMAGING = ImagingSpec(pixel_size=0.01)


def main(experiment=EXPERIMENT, imaging=IMAGING, folder="out/example"):
    """Return, for each strain, the rms per component [px] of w and of the best possible fit."""
    solution = simulate(experiment)
    print("critical strain", solution.info["critical"]["strain"])
    images = make_images(solution, imaging, folder, experiment.strains)
    how, grid, mask = SquareLatticeOptions(), images.grid, images.mask()
    ansatz = how.ansatz(experiment.specimen)

    errors = {}
    for strain in images.strains:
        start = ansatz.initial_guess(strain, how.start_amplitude)
        f, g, g_mask = images.reference(), images.deformed(strain), images.deformed_mask(strain)
        result = correlate(f, g, grid, ansatz, start, mask, g_mask, how.options())
        truth = images.truth(strain).displacement
        best = fit_displacement(truth, grid, ansatz, result.unknowns, mask)
        errors[strain] = [
            np.sqrt(np.mean((truth - fit.displacement())[mask] ** 2)) / grid.pixel_size
            for fit in (result, best)
        ]
        print(strain, result.outcome.name, result.mode_parameters(), errors[strain])
    return errors


if __name__ == "__main__":
    main()
