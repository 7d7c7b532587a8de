"""Photographs of a cellular specimen: material, holes, region, initial guess and measurement."""
