"""Finite elements: lattices, specimens, materials, equilibrium, stability, the path through buckling."""
