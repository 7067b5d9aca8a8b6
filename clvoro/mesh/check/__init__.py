"""Is a mesh what it claims to be? Recomputed on the host, from its arrays alone."""

from .mesh import check_diagram, check_result

__all__ = ["check_diagram", "check_result"]
