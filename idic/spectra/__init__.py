"""Spectra of displacement fields, their waves, and the mode families that these make."""
