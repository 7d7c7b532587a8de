"""What noise does: bias, scatter, error bars."""
