"""Verification of meshes on the host, from their arrays alone."""

from .mesh import check_diagram, check_result

__all__ = ["check_diagram", "check_result"]
