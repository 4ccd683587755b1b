"""Damaged, hostile and unusual EXR files."""
