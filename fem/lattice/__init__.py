"""Infinite lattices by one periodic cell: meshes, periodicity, macroscopic loading, equilibrium."""
