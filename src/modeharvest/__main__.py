"""``python -m modeharvest`` is the ``modeharvest`` command."""

from modeharvest.cli import main

main()
