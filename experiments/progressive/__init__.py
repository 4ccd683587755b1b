"""SURE, and progressive denoising."""
