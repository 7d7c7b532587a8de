"""Integrated digital image correlation: the displacement of a pair of images as v0 + sum v_i phi_i.

The data flow in one direction:

    image pair, ansatz --> solver --> correlate --> result --> uncertainty
    local, spectra --> modes and an initial guess
    photograph: what photographs show, and all of the above on them
"""
