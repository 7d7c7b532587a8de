"""Validation: how far measurements are from the truth, and why."""
