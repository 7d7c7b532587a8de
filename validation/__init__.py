"""Validation: errors of measurements against the truth, and their causes."""
