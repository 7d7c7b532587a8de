"""The minimiser: compiled passes over pixels, normal equations, Gauss-Newton, coarse to fine."""
