"""Files of a camera: read, turned to grey, judged."""
