"""Modes measured on specimens that differ, against those of infinite lattices."""
