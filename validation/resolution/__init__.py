"""Spatial resolution: how fine a displacement a measurement resolves, and at what noise."""
