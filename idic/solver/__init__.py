"""The minimiser: passes over pixels, normal equations, Gauss-Newton, coarse to fine; noise, residual test."""
