"""James-Stein combination, and cross-regression."""
