"""Diagrams and results as NumPy arrays: connectivity, faces, quality, verification."""
