"""Reports as data: text and content; output as HTML, as CSV and on the terminal."""
