"""Uncorrelated kernels."""
