"""Triangulated surfaces inside a domain in 3D, and the generators beside them."""
