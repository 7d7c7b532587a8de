"""Speckle images whose truth is known at every pixel.

==================  ==============================================================================
grid                pixels and millimetres, the one place for the y flip
speckle             the pattern, known at any point: one layer, or ink on it
speckle_layer       a layer: a thresholded Gaussian field, blurred
periodic_spline     its fast evaluation, with a proved bound of the error
elements            reference elements, polynomials over them
jacobian            proof that an element's map is one to one
isoparametric       inverse mapping: element and local coordinates of every pixel
rasterise           its compiled kernels: bands of rows, their elements, who covers a pixel
inversion           the inverse of one element's map, for a batch of pixels
pointwise           inverse mapping at points anywhere, as a lens shows them
render              reference and deformed images, and the truth behind them
distorted           the same through a lens that distorts
calibration_target  a flat target on a stage, to calibrate that lens from
aperture            what one pixel averages: its area, behind the lens's blur
integrate           images whose pixels average over it
sensor              gain, offset, noise, saturation, rounding, and the noise foretold
spec, imageset      what to image, and the folder of files that comes of it
truth, io           truth files; images and masks from and to files
interpolation       values and gradients of a measured image between its pixels
==================  ==============================================================================
"""
