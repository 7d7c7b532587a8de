"""Micromorphic homogenization with given patterns; both scales are solved simultaneously."""
