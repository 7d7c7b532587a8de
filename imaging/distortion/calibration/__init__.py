"""A lens's distortion from photographs of a shifted target, or from a pair of images."""
