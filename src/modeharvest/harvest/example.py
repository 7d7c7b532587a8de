"""A commented experiment file with every table and key: a start for a user's own."""

from __future__ import annotations

EXAMPLE = """\
# Photographs of a test, for: modeharvest harvest experiment.toml --out DIR
# What stands here must be given. Lines behind "#" are options with their defaults or, marked by
# "e.g.", examples. Names of files are relative to this file, and may hold wildcards.
# Positions are [column, row] in px from the middle of the photograph's upper left pixel.

title = "Compression test"

[images]
reference = "reference.tif"          # the undeformed state: TIFF, PNG or JPEG
deformed = ["deformed_*.tif"]        # in the order of the test
# repeats = []                       # more exposures of the reference: they measure the noise

[scale]                              # one of the two:
pixel_size = 0.0125                  # mm/px
# line = [[100, 80], [900, 80]]      # e.g. the ends of a line in the reference ...
# length = 10.0                      # e.g. and its length in mm

[specimen]
cell_size = 1.9                      # mm, the distance of neighbouring holes
# polygon = []                       # corners of the cellular part; found from the holes
# cells = ""                         # or a mask image of it, white inside
# material = ""                      # mask image of the reference's material; found from the image
# deformed_material = []             # and of each deformed image's

# [[specimen.regions]]               # only for parts with patterns of their own, each its table:
# name = "upper half"                # e.g.
# polygon = [[200, 100], [1800, 100], [1800, 900], [200, 900]]   # e.g.

[distortion]                         # of the lens; none, a file, or images to calibrate from
# file = ""                          # JSON of modeharvest, OpenCV's YAML or XML, DICe's XML
# calibration = []                   # images of a speckle target, shifted in its plane
# shifts = []                        # their shifts [along columns, along rows] in px, if known

[local]                              # a local DIC, for spectra and for what the modes leave over
# code = "none"                      # "none", "pyvale", or "file" for fields of any other code
# files = []                         # one for each deformed image: CSV, NPZ, HDF5, MAT
# unit = "auto"                      # of the files: "px", "mm", "auto" as their columns' names say
# y_axis = "auto"                    # of the files: "down", "up", "auto"
# first_pixel = 0                    # what the files call the first pixel, 0 or 1
# columns = {}                       # where names don't tell: { x = 1, y = 2, u = "dX", v = "dY" }
# subset = 21                        # px, odd; with "pyvale"
# step = 5                           # px; with "pyvale"

[noise]
# sd = 2.0                           # e.g. grey levels; else from the repeats, or estimated

[correlation]
# v0_degree = 5                      # total degree of the smooth field v0
# v_degree = 6                       # of every mode's amplitude
# family = "auto"                    # "auto" from the spectrum, or "square": the paper's Eq. (mode)
# hold_mode = "auto"                 # "auto" where no pattern is seen, true or false
# gain_degree = 0                    # e.g. the light changes between the photographs: by a factor
# offset_degree = 0                  # e.g. and by a summand; higher degrees for uneven changes
# edge_px = 3                        # rim of the material that is not compared
# order = 5                          # e.g. of the spline: 3, 5 or 11; else as the speckle asks for
# formulation = "total"              # "total", or "updated" for speckles that change on the way
"""
