"""Scoring: displacement fields of any DIC code against the truth of a benchmark image set."""
