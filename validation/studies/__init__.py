"""Studies: how a measurement's error depends on its start, on noise, on options, on the specimen.

A study is a grid of cases (:mod:`modeharvest.validation.campaign`), the function that runs one of
them, and statistics of the table of their results.
"""
