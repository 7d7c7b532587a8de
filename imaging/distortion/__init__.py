"""Optical distortion: kinds of lenses, their exact inverses, undistorted images, calibration."""
