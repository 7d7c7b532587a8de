"""The report of a harvest: what photographs of a test have shown."""
