"""The report of an infinite lattice, and how its modes depend on it."""
