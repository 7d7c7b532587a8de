"""Bloch waves on deformed lattices: eigenvalues, critical loads, dispersion, modes, branches."""
