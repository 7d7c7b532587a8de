"""A virtual laboratory for integrated DIC on mechanical metamaterials.

Four packages, used from left to right: ``fem`` (the exact displacement), ``imaging``
(speckle images of it), ``idic`` (measure those images), ``validation`` (how large the errors
are). ``runs`` joins them, ``report`` shows what they found, ``cli`` is the command line.
"""

from __future__ import annotations

__version__ = "0.1.0"
