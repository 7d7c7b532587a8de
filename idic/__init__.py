"""Micromorphic integrated digital image correlation."""
