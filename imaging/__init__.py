"""Speckle images whose truth is known at every pixel."""
