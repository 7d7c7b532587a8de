"""Tools of every package that contain no mechanics or imaging: files, stages, options, progress."""

__version__ = "0.1.0"
