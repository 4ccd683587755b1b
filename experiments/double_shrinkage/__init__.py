"""Double shrinkage of two integrators."""
