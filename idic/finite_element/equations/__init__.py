"""Linear systems of nodal displacements: pixels and their sums, regularisation, the factor."""
