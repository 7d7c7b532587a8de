"""Infinite lattices as one periodic cell: mesh, periodicity, macroscopic loading, equilibrium."""
