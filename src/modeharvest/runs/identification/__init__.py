"""Runs that identify material parameters and boundary conditions from images and forces."""
