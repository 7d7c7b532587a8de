"""Optical distortion: kinds of lenses, their exact inverses, images freed from them."""
