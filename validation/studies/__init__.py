"""Studies: how the measurement's error depends on what it starts from, on noise, on options.

A study is a grid of cases (:mod:`modeharvest.validation.campaign`), the function that runs one of
them, and what the table of their results tells.
"""
