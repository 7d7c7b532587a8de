"""Reports of studies: what a table of many cases shows, in numbers, sentences and figures."""
