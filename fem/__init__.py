"""Finite elements: specimens and lattices, their equilibrium, stability and buckled branches.

``field``, ``specimen``, ``materials`` and ``experiment`` are plain numpy; everything else needs
dolfinx. A complete simulation of a specimen::

    from modeharvest.fem.experiment import Experiment
    from modeharvest.fem.simulate import simulate
    solution = simulate(Experiment(strains=(0.078, 0.128)))

``path`` follows a specimen through buckling, ``lattice`` has periodic cells of infinite
lattices, ``bloch`` computes their Bloch waves.
"""
