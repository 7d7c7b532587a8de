"""Runs: a case from its TOML file to a folder of results, in stages that can be resumed.

A module, or a folder, for each kind: virtual experiments, lattices, photographs, studies,
benchmarks for DIC codes, and the twin of a real experiment.
"""
