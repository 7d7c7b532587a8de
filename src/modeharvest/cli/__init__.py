"""The command line: a file for each family of commands, and ``root``, which joins them."""

from modeharvest.cli.root import app, main

__all__ = ["app", "main"]
