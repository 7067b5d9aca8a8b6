"""Diagrams of polygonal domains: convex cells, clipped by the boundary."""
