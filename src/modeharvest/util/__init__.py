"""What every package needs and none of the science: files, stages, options, progress."""

__version__ = "0.1.0"
