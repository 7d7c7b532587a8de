"""Studies of a measurement's error: effect of initial guess, noise, options and specimen."""
