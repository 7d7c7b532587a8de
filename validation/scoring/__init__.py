"""Scoring: fields of any DIC code against the truth of an image set, and on the star pattern."""
