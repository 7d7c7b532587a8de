"""Speckle patterns that are known exactly everywhere, and their fast evaluation."""
