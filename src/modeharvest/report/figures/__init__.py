"""Figures of all reports, drawn with matplotlib."""
