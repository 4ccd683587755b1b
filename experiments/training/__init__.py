"""Training of networks, and what they gain."""
