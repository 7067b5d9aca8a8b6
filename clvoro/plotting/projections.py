"""Cells of a sphere as polygons in a plane: the globe from far away, or longitudes and latitudes.

Both projections map every point of the outline of a cell alike, whichever cell it belongs to. So neighboring polygons
have common sides, without gaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from ..geometry.sphere import Sphere, directions
from ..mesh.connectivity import following, take_rows
from ..mesh.diagram import Diagram

_STEP = 2.0  # longest straight part of an outline, degrees of a great circle
_TURN = 4.0  # largest difference of longitude along it, for longitudes and latitudes
_POLE = 90 - 1e-9  # latitudes beyond are at a pole


@dataclass(frozen=True)
class Polygons:
    """Cells in the plane.

    Attributes
    ----------
    cells : (k,) int
        Rows of the cells, in the order of drawing. With longitudes and latitudes a cell may occur twice.
    starts : (k + 1,) int
    corners : (c, 2) float
        Polygon i, ``corners[starts[i]:starts[i + 1]]``, counter-clockwise.
    faces : (c,) int
        Half-face to which the side from a corner to the next one belongs; -1 for sides along the limb or a pole.
    """

    cells: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    faces: np.ndarray

    def sides(self) -> np.ndarray:
        """Return both ends of the side that begins in each corner, (c, 2, 2)."""
        return np.stack([self.corners, self.corners[following(self.starts)]], axis=1)


class Orthographic:
    """Parallel projection of the front half of a unit sphere; (0, 0) is the center.

    Parameters
    ----------
    center : (lon, lat), degrees
        The point in the middle.
    across : float, optional
        Angle in degrees that the shown part spans through its middle; by default the whole globe.
    """

    def __init__(self, center: tuple[float, float], across: float | None = None) -> None:
        lon, lat = np.radians(center)
        self.right = np.array([-np.sin(lon), np.cos(lon), 0.0])
        self.towards = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        self.up = np.cross(self.towards, self.right)
        self.whole = across is None
        half = 1.012 if across is None else float(np.sin(np.radians(across) / 2))
        self.lower, self.upper = np.array([-half, -half]), np.array([half, half])
        self.span = 180.0 if across is None else float(across)
        self.unit = 1.0
        """Length in the picture of an arc of one radian, in the middle."""

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return the places of unit vectors (n, 3), (n, 2); those behind are moved outwards, beyond the limb.

        They are the farther outside the farther behind, so that no side between two of them crosses the limb.
        """
        xy = np.column_stack([points @ self.right, points @ self.up])
        depth = points @ self.towards
        behind = np.flatnonzero(depth < 0)
        length = np.linalg.norm(xy[behind], axis=1)
        xy[behind] *= ((1 - depth[behind]) / np.where(length > 0, length, 1))[:, None]
        return xy

    def reaches(self, points: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return whether cells around unit vectors (n, 3), with corners within `radii`, may be shown; (n,) bool."""
        shown = points @ self.towards > -radii
        for axis, low, high in zip((self.right, self.up), self.lower, self.upper, strict=True):
            x = points @ axis
            shown &= (x > low - radii) & (x < high + radii)
        return shown

    def foreshortening(self, points: np.ndarray) -> np.ndarray:
        """Return the smallest ratio of lengths in the picture to those on the sphere, (n,)."""
        return np.clip(points @ self.towards, 0, 1)

    def polygons(self, diagram: Diagram, cells: np.ndarray) -> Polygons:
        """Return `cells` as polygons; those on the back are left out."""
        if not len(cells):
            return Polygons(cells, np.zeros(1, int), np.empty((0, 2)), np.empty(0, int))
        starts, points, faces = outlines(diagram, cells)
        behind = points @ self.towards < 0
        faces = np.where(behind & behind[following(starts)], -1, faces)
        shown = np.flatnonzero(~np.logical_and.reduceat(behind, starts[:-1]))
        # The outline of a cell around the point opposite to the viewer leaves out what is seen of the cell. All of the
        # disk is drawn first instead, and the other cells over it.
        # A part of a sphere may have no such cell.
        has_back = diagram.domain.contains(-self.towards[None])[0]
        last = np.argmin(diagram.points @ self.towards) if has_back else -1
        order = np.concatenate([shown[cells[shown] == last], shown[cells[shown] != last]])
        kept, places = take_rows(starts, np.arange(len(points)), order)
        corners, faces = self.flat(points[places]), faces[places]
        if len(order) and cells[order[0]] == last:
            angle = np.radians(np.arange(0, 360, _STEP))
            disk, rest = np.column_stack([np.cos(angle), np.sin(angle)]), kept[1]
            corners = np.concatenate([disk, corners[rest:]])
            faces = np.concatenate([np.full(len(disk), -1), faces[rest:]])
            kept = np.concatenate([[0], kept[1:] - rest + len(disk)])
        return Polygons(cells[order], kept, corners, faces)

    def lines(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the visible parts of a line through unit vectors (n, 3), each (k, 2)."""
        front = points @ self.towards >= 0
        parts = np.split(np.arange(len(points)), np.flatnonzero(np.diff(front)) + 1)
        flat = self.flat(points)
        return [flat[part] for part in parts if front[part[0]] and len(part) > 1]

    def directions(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which `places` (n, 2) are on the globe, (n,) bool, and unit vectors of those, (k, 3)."""
        square = (places**2).sum(axis=1)
        inside = square < 1
        x, y = places[inside].T[:, :, None]
        depth = np.sqrt(1 - square[inside])[:, None]
        return inside, x * self.right + y * self.up + depth * self.towards


class Plate:
    """Longitudes and latitudes in degrees (plate carrée).

    Parameters
    ----------
    center : (lon, lat), degrees
        The longitude in the middle; the latitude is not used.
    window : ((lon, lat), (lon, lat)), optional
        Corners of the shown part; by default everything.
    """

    def __init__(self, center: tuple[float, float], window: np.ndarray | None = None) -> None:
        middle = center[0] if window is None else float(window[:, 0].mean())
        self.whole, self.middle = window is None, middle
        corners = [(middle - 180, -90), (middle + 180, 90)] if window is None else window
        self.lower, self.upper = np.array(corners, float)
        self.span = float(self.upper[1] - self.lower[1])
        self.unit = 180 / np.pi

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return the places of unit vectors (n, 3), (n, 2), within 180 degrees of the middle."""
        lonlat = directions(points)
        lonlat[:, 0] = self.middle + _turn(lonlat[:, 0] - self.middle)
        return lonlat

    def reaches(self, points: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return whether cells around unit vectors (n, 3), with corners within `radii`, may be shown; (n,) bool."""
        lat, reach = (directions(points)[:, 1], 60 * radii)  # the angle over a chord is up to pi / 2 times as long
        return (lat > self.lower[1] - 1.5 * reach) & (lat < self.upper[1] + 1.5 * reach)

    def foreshortening(self, points: np.ndarray) -> np.ndarray:
        """Return 1: no length in the picture is smaller than on the sphere."""
        return np.ones(len(points))

    def polygons(self, diagram: Diagram, cells: np.ndarray) -> Polygons:
        """Return `cells` as polygons, those at the limits of longitude on both sides."""
        if not len(cells):
            return Polygons(cells, np.zeros(1, int), np.empty((0, 2)), np.empty(0, int))
        starts, points, faces = outlines(diagram, cells, _turns(diagram, cells))
        corners = directions(points)
        first, next_ = starts[:-1], following(starts)
        jumps = -np.round((corners[next_, 0] - corners[:, 0]) / 360).astype(int)
        steps = corners[next_, 0] - corners[:, 0] + 360 * jumps
        polar = np.add.reduceat(jumps, first) != 0
        odd = (np.abs(corners[:, 1]) > _POLE) | (np.abs(steps) > 180 - 1e-6)
        polar |= np.logical_or.reduceat(odd, first)
        # Longitudes go on beyond 180 degrees, along the outline from its first corner.
        turns = np.cumsum(jumps) - jumps
        corners[:, 0] += 360 * (turns - np.repeat(turns[first], np.diff(starts)))
        plain = np.flatnonzero(~polar)
        kept, places = take_rows(starts, np.arange(len(points)), plain)
        parts = [Polygons(cells[plain], kept, corners[places], faces[places])]
        for i in np.flatnonzero(polar):
            row = slice(starts[i], starts[i + 1])
            ring, of = _around_pole(directions(points[row]), faces[row])
            parts.append(Polygons(cells[i : i + 1], np.array([0, len(ring)]), ring, of))
        return self._images(_joined(parts))

    def _images(self, one: Polygons) -> Polygons:
        """Return all copies of polygons, 360 degrees apart, that reach into the picture."""
        if not len(one.cells):
            return one
        low, high = (f.reduceat(one.corners, one.starts[:-1]) for f in (np.minimum, np.maximum))
        seen = (high[:, 1] > self.lower[1]) & (low[:, 1] < self.upper[1])
        parts = []
        for by in 360.0 * np.arange(-3, 4):
            # An image must reach in by more than round-off.
            inside = (high[:, 0] + by > self.lower[0] + 1e-9) & (low[:, 0] + by < self.upper[0] - 1e-9)
            rows = np.flatnonzero(seen & inside)
            starts, places = take_rows(one.starts, np.arange(len(one.corners)), rows)
            corners = one.corners[places] + (by, 0.0)
            parts.append(Polygons(one.cells[rows], starts, corners, one.faces[places]))
        return _joined(parts)

    def lines(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the parts of a line through unit vectors (n, 3) between the limits of longitude, each (k, 2)."""
        flat = self.flat(points)
        parts = np.split(flat, np.flatnonzero(np.abs(np.diff(flat[:, 0])) > 180) + 1)
        return [part for part in parts if len(part) > 1]

    def directions(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which `places` (n, 2) are latitudes, (n,) bool, and unit vectors of those, (k, 3)."""
        inside = np.abs(places[:, 1]) <= 90
        return inside, unit_vectors(places[inside])


def unit_vectors(lonlat: np.ndarray) -> np.ndarray:
    """Return the unit vectors (n, 3) of longitudes and latitudes (n, 2) in degrees."""
    lon, lat = np.radians(lonlat).T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def outlines(
    diagram: Diagram, cells: np.ndarray, parts: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the outlines of `cells` on the unit sphere with long arcs divided into short parts.

    Parameters
    ----------
    diagram : Diagram
        On a sphere.
    cells : (k,) int
    parts : (f,) int, optional
        Least number of parts of the faces of `cells`; by default 1.

    Returns
    -------
    starts : (k + 1,) int
    points : (p, 3) float
        Unit vectors, ``points[starts[i]:starts[i + 1]]`` counter-clockwise around cell i.
    faces : (p,) int
        The half-face on which a point and the next one are.
    """
    begin, middle, end, starts, rows = _arcs(diagram, cells)
    angle = np.degrees(diagram.face_measures[rows] / cast("Sphere", diagram.domain).radius)
    # An even number, so that both cells of a face have the same points, and one of them is the middle.
    counts = np.where(angle > _STEP, 2 * np.ceil(angle / (2 * _STEP)).astype(int), 1)
    if parts is not None:
        counts = np.maximum(counts, parts)
    ends = np.cumsum(counts)
    arc = np.repeat(np.arange(len(rows)), counts)
    share = (np.arange(len(arc)) - (ends - counts)[arc]) / counts[arc]
    early = share < 0.5
    weight = np.where(early, 2 * share, 2 * share - 1)[:, None]
    points = np.where(early[:, None], begin[arc], middle[arc]) * (1 - weight)
    points += np.where(early[:, None], middle[arc], end[arc]) * weight
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.concatenate([[0], ends])[starts], points, rows[arc]


def _arcs(diagram: Diagram, cells: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return begin, middle and end of the faces of `cells`, (f, 3) unit vectors each, starts, and half-faces (f,)."""
    radius = cast("Sphere", diagram.domain).radius
    starts, rows = take_rows(diagram.cell_vertex_starts, np.arange(len(diagram.cell_vertices)), cells)
    begin = diagram.vertices[diagram.cell_vertices[rows]] / radius
    return begin, diagram.face_centroids[rows] / radius, begin[following(starts)], starts, rows


def _turns(diagram: Diagram, cells: np.ndarray) -> np.ndarray:
    """Return the number of parts in which longitudes differ little, for each face of `cells`."""
    begin, middle, end, _, _ = _arcs(diagram, cells)
    a, b, c = (directions(x)[:, 0] for x in (begin, middle, end))
    largest = np.maximum(np.abs(_turn(b - a)), np.abs(_turn(c - b)))
    return np.where(largest > _TURN, 2 * np.ceil(largest / _TURN).astype(int), 1)


def _turn(degrees: np.ndarray) -> np.ndarray:
    """Return angles within 180 degrees."""
    return degrees - 360 * np.round(degrees / 360)


def _around_pole(lonlat: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the polygon (k, 2) of a cell with a pole inside or on its outline, and the half-faces of its sides.

    A pole is a line in the picture. An outline through it goes along that line: with the cell on its left westward at
    the north pole, eastward at the south pole. Around a pole the polygon spans 360 degrees, and ends in that line.
    """
    at_pole = np.abs(lonlat[:, 1]) > _POLE
    if at_pole.all():
        return np.empty((0, 2)), np.empty(0, int)
    first = int(np.argmin(at_pole))
    lonlat, faces, at_pole = (np.roll(a, -first, axis=0) for a in (lonlat, faces, at_pole))
    corners, of = [lonlat[0]], [faces[0]]
    lon, pole, face = lonlat[0, 0], 0.0, faces[0]
    for k in [*range(1, len(lonlat)), 0]:
        if at_pole[k]:
            pole, face = np.sign(lonlat[k, 1]), faces[k]
            continue
        step = _turn(lonlat[k, 0] - lon)
        if not pole and abs(step) > 180 - 1e-6:  # through a pole between two points
            pole, face = np.sign(corners[-1][1] + lonlat[k, 1]), of[-1]
        if pole:
            step = (lonlat[k, 0] - lon) % 360 - (360 if pole > 0 else 0)
            corners += [np.array([lon, 90 * pole]), np.array([lon + step, 90 * pole])]
            of += [-1, face]
        lon, pole = lon + step, 0.0
        corners.append(np.array([lon, lonlat[k, 1]]))
        of.append(faces[k])
    around = lon - lonlat[0, 0]
    if abs(around) > 180:
        side = 90.0 * np.sign(around)
        corners += [np.array([lon, side]), np.array([lonlat[0, 0], side])]
        of[-1:] = [-1, -1, -1]
        return np.array(corners), np.array(of)
    return np.array(corners[:-1]), np.array(of[:-1])  # the last is the first


def _joined(parts: list[Polygons]) -> Polygons:
    """Return several sets of polygons as one."""
    sizes = np.concatenate([np.diff(part.starts) for part in parts])
    return Polygons(
        np.concatenate([part.cells for part in parts]),
        np.concatenate([[0], np.cumsum(sizes)]),
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.faces for part in parts]),
    )
