"""A specimen's equilibrium path: Newton's method, stability, critical point, branches."""
