"""From spectra to waves, from waves to families of modes."""
