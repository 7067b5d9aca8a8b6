"""Repair of solver meshes in 2D: points move, and faces connect other cells."""
