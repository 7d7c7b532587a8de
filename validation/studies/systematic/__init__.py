"""What is wrong without any noise: one option at a time."""
