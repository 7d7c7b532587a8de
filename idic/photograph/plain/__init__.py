"""Photographs of a plain specimen, without speckle: its material, its contours, holes and dots."""
