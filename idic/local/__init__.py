"""Local DIC: displacement fields at points, their files, and subsets by pyvale."""
