"""Write meshes of polygons by the UGRID conventions, for QGIS, ParaView, xarray and similar programs.

See https://ugrid-conventions.github.io/ugrid-conventions. Vertices are nodes and cells are faces. Indices begin with 0;
-1 stands for a missing item. As in VTK files, cells are not cut at seams: each side of a seam has separate nodes
and edges. The loops of a cell around an island are joined by bridges, edges that are passed in both directions.

On a sphere coordinates are longitudes and latitudes in degrees, and edges are arcs of great circles.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.sphere import Sphere
from ..mesh.diagram import Diagram
from ..mesh.half_faces import HalfEdges
from .contents import Contents
from .netcdf import NetCDF, squared

_CONNECTIVITY = {
    "face_node": "corners of each face, counter-clockwise",
    "edge_node": "ends of each edge",
    "face_edge": "edges of each face, counter-clockwise",
    "face_face": "faces across the edges of each face",
    "edge_face": "faces on the left and on the right of each edge",
}
_FACE_DATA = {"size": "target size", "error": "size error", "quality": "cell quality", "area": "cell area"}
"""Names of cell data, and their titles in other programs."""
_NONE = np.int32(-1)


def write_ugrid(contents: Contents, path: Path, unit: str = "m") -> None:
    """Write the cells with size, error, quality and area, and the number and name of the wall at each edge.

    The coordinates of faces are the generators, those of edges their middles, all in `unit`. With "degrees" they are
    longitudes and latitudes, otherwise coordinates of a projection. On a sphere they are always longitudes and
    latitudes, and `unit` is that of the radius. Names of boundaries are the flags of the variable `boundary`.
    """
    _describe(contents, path, unit).write()


def _describe(contents: Contents, path: Path, unit: str) -> NetCDF:
    diagram = contents.diagram
    halves = diagram.half_faces.edges(glued=False)
    starts, corners = diagram.half_faces.cell_corners
    dimensions = {
        "mesh_nodes": len(diagram.vertices),
        "mesh_edges": len(halves.first),
        "mesh_faces": len(diagram),
        "mesh_most_corners": int(np.diff(starts).max()),
        "two": 2,
    }
    file = NetCDF(path, contents, dimensions, {"Conventions": "CF-1.11 UGRID-1.0"})
    places = ("node", "edge", "face")
    file.add(
        "mesh",
        (),
        np.zeros((), np.int32),
        cf_role="mesh_topology",
        long_name="topology of the cells",
        topology_dimension=np.int32(2),
        face_dimension="mesh_faces",
        edge_dimension="mesh_edges",
        **{f"{place}_coordinates": f"mesh_{place}_x mesh_{place}_y" for place in places},
        **{f"{name}_connectivity": f"mesh_{name}s" for name in _CONNECTIVITY},
    )
    ends = np.stack([halves.begin, halves.end], axis=1)[halves.first]
    _add_coordinates(file, diagram, ends, unit)
    _add_connectivity(file, halves, ends, np.diff(starts), corners)
    of_faces = {"mesh": "mesh", "location": "face", "coordinates": "mesh_face_x mesh_face_y"}
    if diagram.domain.globe is not None:
        _add_globe(file, diagram.domain.globe, unit)
        of_faces["grid_mapping"] = "globe"
    units = {"size": unit, "area": squared(unit)}
    for name, values in {**contents.of_run, "area": diagram.volumes}.items():
        about = {"long_name": _FACE_DATA[name], "units": units.get(name, "1")}
        file.add(name, ("mesh_faces",), values, **about, **of_faces)
    _add_walls(file, diagram, halves)
    file.add_extra("mesh_faces", **of_faces)
    return file


def _add_coordinates(file: NetCDF, diagram: Diagram, ends: np.ndarray, unit: str) -> None:
    places = {
        "node": ("corners of the cells", diagram.vertices),
        "edge": ("middles of the edges", diagram.vertices[ends].mean(axis=1)),
        "face": ("generators of the cells", diagram.points),
    }
    globe = diagram.domain.globe
    if globe is not None:
        unit = "degrees"
        places = {place: (what, globe.lonlat(x)) for place, (what, x) in places.items()}
    for place, (what, points) in places.items():
        for axis, values in zip("xy", points.T, strict=True):
            file.add(
                f"mesh_{place}_{axis}",
                (f"mesh_{place}s",),
                values,
                **_coordinate(axis, unit),
                long_name=f"{axis} of the {what}",
                axis=axis.upper(),
            )


def _add_globe(file: NetCDF, sphere: Sphere, unit: str) -> None:
    """Add the radius of the sphere by the CF conventions, which have it in meters, and in the unit of the file."""
    radius = {"earth_radius": np.float64(sphere.radius)} if unit == "m" else {}
    file.attributes["sphere_radius"] = np.float64(sphere.radius)
    file.add("globe", (), np.zeros((), np.int32), grid_mapping_name="latitude_longitude", **radius)


def _add_connectivity(
    file: NetCDF, halves: HalfEdges, ends: np.ndarray, sides: np.ndarray, corners: np.ndarray
) -> None:
    across = np.where(halves.twin >= 0, halves.cell[halves.twin], -1)
    rows = {
        "face_node": (sides, corners),
        "face_edge": (halves.counts, halves.edge),
        "face_face": (halves.counts, across),
    }
    for name, (counts, items) in rows.items():
        columns = ("mesh_faces", "mesh_most_corners")
        file.add_rows(f"mesh_{name}s", columns, counts, items, -1, **_role(name), _FillValue=_NONE)
    pairs = ("mesh_edges", "two")
    # Every edge has two ends, so the conventions require no fill value here.
    file.add("mesh_edge_nodes", pairs, ends, **_role("edge_node"))
    beside = np.stack([halves.cell, across], axis=1)[halves.first]
    file.add("mesh_edge_faces", pairs, beside, **_role("edge_face"), _FillValue=_NONE)


def _add_walls(file: NetCDF, diagram: Diagram, halves: HalfEdges) -> None:
    """Add the number of the wall of each edge, and the name of its boundary as a flag."""
    of_edges: dict[str, str | np.generic] = {
        "mesh": "mesh",
        "location": "edge",
        "coordinates": "mesh_edge_x mesh_edge_y",
        "_FillValue": _NONE,
    }
    walls = np.maximum(-1 - diagram.neighbors[halves.rows[halves.first]], -1)
    file.add("wall", ("mesh_edges",), walls, long_name="number of the wall of the edge", **of_edges)
    names = diagram.domain.boundary_names
    if names:
        parts = np.where(walls >= 0, diagram.domain.boundary_index[np.maximum(walls, 0)], -1)
        file.add(
            "boundary",
            ("mesh_edges",),
            parts,
            long_name="boundary that the edge is part of",
            flag_values=np.arange(len(names), dtype=np.int32),
            flag_meanings=" ".join(names),
            **of_edges,
        )


def _coordinate(axis: str, unit: str) -> dict[str, str]:
    """Return the attributes of a horizontal coordinate by the CF conventions."""
    if unit == "degrees":
        name, direction = ("longitude", "east") if axis == "x" else ("latitude", "north")
        return {"standard_name": name, "units": f"degrees_{direction}"}
    return {"standard_name": f"projection_{axis}_coordinate", "units": unit}


def _role(name: str) -> dict[str, str | np.generic]:
    return {"cf_role": f"{name}_connectivity", "long_name": _CONNECTIVITY[name], "start_index": np.int32(0)}
