"""Experiments with jscomb: one question per file."""
