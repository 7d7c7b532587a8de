"""Reports for readers: pages, figures, tables and terminal output; nothing here computes results."""
