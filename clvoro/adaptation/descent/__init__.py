"""Descent of energies of the cells: their quality, and short edges."""
