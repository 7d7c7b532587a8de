"""Runs of homogenized specimens."""
