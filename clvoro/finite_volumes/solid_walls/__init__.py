"""The mesh of a solid: cells of a Voronoi diagram that end at a triangulated surface, by names of vertices."""
