"""From images to an ansatz and a start, with no number typed."""
