"""Parameters of a finite-element model from what was observed of its states."""
