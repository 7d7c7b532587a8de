"""The inverse isoparametric mapping: each pixel's element and local coordinates."""
