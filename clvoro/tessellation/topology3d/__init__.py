"""Faces and vertices of cells in 3D, made identical in all cells that share them."""
