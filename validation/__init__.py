"""How wrong a measurement was, and why."""
