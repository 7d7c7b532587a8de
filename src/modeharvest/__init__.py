"""modeharvest: a virtual laboratory for integrated DIC on mechanical metamaterials.

Four packages, used from left to right: ``fem`` (the exact displacement), ``imaging``
(speckle images of it), ``idic`` (measure those images), ``validation`` (how wrong it was).
"""

__version__ = "0.1.0"
