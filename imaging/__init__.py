"""Speckle images whose truth is known at every pixel, photographs, and lenses.

``spec`` and ``imageset`` make sets of images of a deforming specimen; ``render`` shows one state,
``camera`` and ``sensor`` what a camera makes of it; ``grid`` relates pixels to millimetres and is
the one place for the y flip; ``spline`` gives values and gradients of a measured image between its
pixels. ``speckle`` is the pattern, known at any point, ``mapping`` the inverse isoparametric
mapping, ``photographs`` the files of a camera, ``distortion`` lenses and their calibration.
"""
