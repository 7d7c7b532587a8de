"""Finite elements: specimen, mesh, material, equilibrium, stability, the path through buckling.

``field`` and ``specimen`` are plain numpy; everything else needs dolfinx. The whole of it::

    from modeharvest.fem.simulate import Experiment, simulate
    solution = simulate(Experiment(strains=(0.078, 0.128)))
"""
