"""Scoring of fields of any DIC code: against an image set's truth, and on the star pattern."""
