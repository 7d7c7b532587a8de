"""Speckle patterns known exactly at any point, and their fast evaluation."""
