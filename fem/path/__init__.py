"""A specimen's equilibrium path: Newton's method, stability, the critical point, the branches."""
