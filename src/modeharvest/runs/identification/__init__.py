"""Runs that identify material and supports."""
