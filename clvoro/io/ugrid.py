"""Meshes in the plane by the UGRID conventions, for QGIS, ParaView, xarray and its kin.

https://ugrid-conventions.github.io/ugrid-conventions: vertices are nodes, cells are faces. Indices begin with 0, what
is not there is -1. As in VTK's files cells are not cut at seams, on both sides of which nodes and edges are there for
each, and a cell with an island in it has its loops joined by bridges there and back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..mesh.connectivity import cell_corners
from .contents import Contents
from .half_edges import half_edges
from .netcdf import NetCDF, squared

_CONNECTIVITY = {
    "face_node": "corners of each face, counter-clockwise",
    "edge_node": "ends of each edge",
    "face_edge": "edges of each face, counter-clockwise",
    "face_face": "faces across the edges of each face",
    "edge_face": "faces on the left and on the right of each edge",
}
_FACE_DATA = {
    "size": "target size",
    "error": "size error",
    "quality": "cell quality",
    "area": "cell area",
}
"""With what programs call them."""


def write_ugrid(contents: Contents, path: Path, unit: str = "m") -> None:
    """Write the cells with size, error, quality and area, and the number and name of the wall at each edge.

    The coordinates of faces are the generators, those of edges their middles, all in `unit`. With "degrees" they are
    longitudes and latitudes, otherwise coordinates of a projection. Names of boundaries are the flags of the
    variable `boundary`.
    """
    _describe(contents, path, unit).write()


def _describe(contents: Contents, path: Path, unit: str) -> NetCDF:
    diagram = contents.diagram
    halves = half_edges(diagram, glued=False)
    starts, corners = cell_corners(diagram)
    sides = np.diff(starts)
    n, e, first = len(diagram), len(halves.first), halves.first
    width = int(sides.max())
    file = NetCDF(
        path,
        contents,
        {
            "mesh_nodes": len(diagram.vertices),
            "mesh_edges": e,
            "mesh_faces": n,
            "mesh_most_corners": width,
            "two": 2,
        },
        {"Conventions": "CF-1.11 UGRID-1.0"},
    )
    file.add(
        "mesh", (), np.zeros((), np.int32),
        cf_role="mesh_topology", long_name="topology of the cells", topology_dimension=np.int32(2),
        face_dimension="mesh_faces", edge_dimension="mesh_edges",
        **{f"{place}_coordinates": f"mesh_{place}_x mesh_{place}_y" for place in ("node", "edge", "face")},
        **{f"{name}_connectivity": f"mesh_{name}s" for name in _CONNECTIVITY},
    )  # fmt: skip
    ends = np.stack([halves.begin, halves.end], axis=1)[first]
    places = {
        "node": ("corners of the cells", diagram.vertices),
        "edge": ("middles of the edges", diagram.vertices[ends].mean(axis=1)),
        "face": ("generators of the cells", diagram.points),
    }
    for place, (what, points) in places.items():
        for axis, values in zip("xy", points.T, strict=True):
            file.add(
                f"mesh_{place}_{axis}", (f"mesh_{place}s",), values,
                **_coordinate(axis, unit), long_name=f"{axis} of the {what}", axis=axis.upper(),
            )  # fmt: skip
    across = np.where(halves.twin >= 0, halves.cell[halves.twin], -1)
    minus = np.int32(-1)
    rows = {
        "face_node": (sides, corners),
        "face_edge": (halves.counts, halves.edge),
        "face_face": (halves.counts, across),
    }
    for name, (counts, items) in rows.items():
        columns = ("mesh_faces", "mesh_most_corners")
        file.add_rows(f"mesh_{name}s", columns, counts, items, -1, **_role(name), _FillValue=minus)
    pairs = ("mesh_edges", "two")
    # No edge lacks an end, and the conventions want no value for that.
    file.add("mesh_edge_nodes", pairs, ends, **_role("edge_node"))
    beside = np.stack([halves.cell, across], axis=1)[first]
    file.add("mesh_edge_faces", pairs, beside, **_role("edge_face"), _FillValue=minus)
    of_faces = {"mesh": "mesh", "location": "face", "coordinates": "mesh_face_x mesh_face_y"}
    units = {"size": unit, "area": squared(unit)}
    for name, values in {**contents.of_run, "area": diagram.volumes}.items():
        file.add(
            name, ("mesh_faces",), values,
            long_name=_FACE_DATA[name], units=units.get(name, "1"), **of_faces,
        )  # fmt: skip
    walls = np.maximum(-1 - diagram.neighbors[halves.rows[first]], -1)
    file.add(
        "wall", ("mesh_edges",), walls,
        long_name="number of the wall that the edge lies on", mesh="mesh", location="edge",
        coordinates="mesh_edge_x mesh_edge_y", _FillValue=minus,
    )  # fmt: skip
    names = diagram.domain.boundary_names
    if names:
        parts = np.where(walls >= 0, diagram.domain.boundary_index[np.maximum(walls, 0)], -1)
        file.add(
            "boundary", ("mesh_edges",), parts,
            long_name="boundary that the edge lies on", mesh="mesh", location="edge",
            coordinates="mesh_edge_x mesh_edge_y", flag_values=np.arange(len(names), dtype=np.int32),
            flag_meanings=" ".join(names), _FillValue=minus,
        )  # fmt: skip
    file.add_extra("mesh_faces", **of_faces)
    return file


def _coordinate(axis: str, unit: str) -> dict[str, str]:
    """Return what CF asks of a horizontal coordinate."""
    if unit == "degrees":
        name, direction = ("longitude", "east") if axis == "x" else ("latitude", "north")
        return {"standard_name": name, "units": f"degrees_{direction}"}
    return {"standard_name": f"projection_{axis}_coordinate", "units": unit}


def _role(name: str) -> dict[str, str | np.generic]:
    return {
        "cf_role": f"{name}_connectivity",
        "long_name": _CONNECTIVITY[name],
        "start_index": np.int32(0),
    }
