"""Uncertainty: image noise, residual test, covariance of the unknowns, identifiability."""
