"""Curves for the boundaries of 2D domains: circles, arcs, ellipses, NACA sections and splines."""

from .geometry.curves import Curve, arc, circle, ellipse, naca, spline

__all__ = ["Curve", "arc", "circle", "ellipse", "naca", "spline"]
