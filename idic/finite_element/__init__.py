"""Finite-element DIC: the whole displacement on a mesh of the material, regularised."""
