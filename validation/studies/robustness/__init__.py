"""Whether the start matters."""
