"""Reports: pages, tables and terminal output of runs."""
