"""The analysis of infinite lattices, from a case file to a folder of results.

``modeharvest bloch`` and ``modeharvest modes``; in Python :mod:`modeharvest.lattice.pipeline`.
"""
