"""Grades of displacement fields from any DIC code, against the truth of a set of images."""
