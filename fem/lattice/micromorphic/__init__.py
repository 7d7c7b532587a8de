"""Micromorphic homogenization: patterns given beforehand, at two scales solved as one."""
