"""What functions cost, and how they grow."""
