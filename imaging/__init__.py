"""Speckle images with a known displacement at every pixel, photographs, and lenses.

``spec`` and ``imageset`` make sets of images of a deforming specimen. ``render`` images one state;
``camera`` and ``sensor`` model the camera. ``grid`` converts between pixels and millimetres and is
the only module that flips y. ``spline`` gives values and gradients of a measured image between its
pixels. ``speckle`` is the pattern, known at any point; ``mapping`` is the inverse isoparametric
mapping; ``photographs`` reads a camera's files; ``distortion`` has lenses and their calibration.
"""
