"""Curves for the boundaries of 2D domains: circles, arcs, ellipses, NACA sections and splines.

A curve takes the place of a ring of a `clvoro.Polygon`, or of some vertices within a ring. The device sees a polyline
whose vertices lie on the curve. The domain keeps the curve itself.
"""

from .curve import Curve
from .forms import arc, circle, ellipse, naca, spline

__all__ = ["Curve", "arc", "circle", "ellipse", "naca", "spline"]
