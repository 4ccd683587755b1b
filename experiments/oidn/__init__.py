"""Open Image Denoise as a network, and its variants."""
