"""Studies: how a measurement's error depends on initial guess, noise, options and specimen."""
