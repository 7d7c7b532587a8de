"""The inverse isoparametric mapping: which element covers a pixel, and where in it."""
