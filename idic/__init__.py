"""Micromorphic integrated digital image correlation.

What is made of what, from the bottom up::

    chebyshev, support, fourier -> ansatz        u = v0 + sum_i v_i phi_i and its unknowns
    moments -> normal_equations                  J'J and J'r of an ansatz, without J
    normal_equations -> gauss_newton             the iteration and its outcome
    pyramid, gauss_newton -> correlate -> result two images in, unknowns with covariance out
    spectrum -> waves -> pattern                 which mode family, and where to start
"""
