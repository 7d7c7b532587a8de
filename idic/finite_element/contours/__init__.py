"""Displacement of a body from its contours alone: a hyperelastic mesh tied to them by springs."""
