"""Simplify polygons: fill bays and channels that are narrower than a cell, drop small islands, remove vertices.

What a disc of the diameter h cannot reach from inside is narrower than h. These places are the Delaunay triangles of
points on the boundary whose circumcircles are smaller than that disc (alpha shapes: Edelsbrunner, Kirkpatrick, Seidel
1983). Each triangle is water or land. To fill a bay is to turn its triangles into land.
"""

from .simplify import DEFAULT_NAME, pieces_of, simplify

__all__ = ["DEFAULT_NAME", "pieces_of", "simplify"]
