"""Holes, and blocks of speckle, of the reference matched with those of a deformed photograph."""
