"""The analysis of infinite lattices, from a case file to a folder of results."""
