"""From photographs to modes: v0, v1 and phi1 with error bars, from a camera's files.

``modeharvest harvest EXPERIMENT.toml --out DIR``, or
:func:`modeharvest.runs.photographs.pipeline.harvest`.
"""
