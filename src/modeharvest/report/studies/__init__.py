"""Reports of studies: results of many cases as numbers, sentences, tables and figures."""
