"""What every package needs and none of the science: files, stages, options, progress."""
