"""Files of images and photographs: read, turned to grey, checked."""
