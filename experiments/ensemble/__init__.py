"""Ensembles of denoisers."""
