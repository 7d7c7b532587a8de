"""The paper's virtual experiment in Python: simulate, image, correlate, compare."""

import modeharvest as mh

EXPERIMENT = mh.Experiment(strains=(0.078, 0.128), mesh_size=0.2)
IMAGING = mh.ImagingSpec(pixel_size=0.01)


def main(experiment=EXPERIMENT, imaging=IMAGING, folder="out/example"):
    """Return, by strain, the rms per component [px] of truth - IDIC and of truth - best fit."""
    solution = mh.simulate(experiment)
    print("critical strain", solution.info["critical"]["strain"])

    errors = {}
    for pair in mh.make_images(solution, imaging, folder, experiment.strains):
        ansatz = mh.Ansatz.square(solution.specimen)
        result = mh.correlate(pair, ansatz, strain=pair.strain)
        best = mh.best_fit(pair.truth, result)
        errors[pair.strain] = [pair.rms(fit) / pair.grid.pixel_size for fit in (result, best)]
        print(pair.strain, result.outcome.name, result.mode_parameters(), errors[pair.strain])
    return errors


if __name__ == "__main__":
    main()
