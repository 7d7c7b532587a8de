"""Displacements at points: those of any DIC code, and their spectra."""
