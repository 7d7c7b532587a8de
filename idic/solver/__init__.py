"""The minimiser: passes over pixels, Gauss-Newton, coarse to fine; image noise, residual test."""
