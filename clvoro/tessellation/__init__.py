"""The Voronoi diagram on the device."""
