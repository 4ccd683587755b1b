"""Every combiner beside every other."""
