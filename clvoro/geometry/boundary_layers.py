"""Boundary layers: layers of cells with given heights along walls; in 2D rows of fixed generators."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import scipy
import shapely

from ..arguments import check_integer, check_number, format_point
from ..errors import InputError, InputTypeError
from .boundary_names import Walls
from .box import Box
from .domain import Domain
from .layer_columns import count_columns, count_fan, find_chains, place_columns, place_fan
from .polygon import Polygon
from .solid.solid import Solid
from .surface import Surface

Size = Callable[[np.ndarray], np.ndarray]
"""Target sizes at points (n, d)."""
_NEAR = 0.6  # of a cell: of two generators that are nearer to each other than this, one is dropped
_SHORT = 1e-9  # of the domain: shorter edges of the region beyond the layers are dropped
_APART = 0.3  # of a width, between the last row and the generators that move
_NO_ROOM = "layers leave no room for other cells; make them thinner, or choose fewer edges"
_TIGHT = 0.25  # share of the columns in gaps without room for them, above which layers are refused
_FILLED = 0.8  # share of a gap that layers may fill
_FACING = -0.5  # cosine between the normals of two walls that face each other
_MOST = 32767  # layers of prisms: their numbers have 16 bits
_SAMPLE = 1024  # points on walls at which sizes are averaged
_INSIDE, _LEAST_RATIO = 1 << 14, 0.7  # points to measure volumes beside walls, least factor on sizes of cells
INNER_DEPTH, DEEPER = 2.0, 8.0
"""Vertices move with a wall that gets layers if they are nearer to it than INNER_DEPTH h + DEEPER thickness."""
OF_GAP = 0.25
"""Share of the distance to the opposite wall that layers of prisms fill."""
COARSER, FINER = 2.0, 1e-3
"""Size of the cells of layers over the size field above which a run warns, and their default width over it below which
it warns."""
THICKEST, FLATTEST, THINNEST = 3.0, 1000.0, 0.02
"""Limits of layers of prisms beyond which a run warns: largest thickness of all layers over the size field, largest
size field over the height of the first layer, and least height of the last layer over the size field."""
NARROWER = 0.8
"""Default width of layers over the size field below which the settings of the result say so."""
SAMPLE = 64
"""Largest number of points along a layer at which its sizes are compared with the size field."""
_OWN = 0.9  # of its distance from its wall: a generator that is nearer to another wall than this is dropped


@dataclass(frozen=True)
class Layers:
    """Boundary layers: layers of cells along walls, for `Adapter.run`, in 2D and in solids.

    In a `Solid` cells in layers are prisms over the polygons of the mesh on the wall: see below. In 2D generators stand
    in columns normal to the wall and do not move. Where the wall is straight, their cells are rectangles, and layer k
    has the height ``height * growth**k``. One more row beyond the last layer makes the outer faces of that layer
    straight, too. Beyond it sizes grow from the width of the columns by the factor `growth` per cell (see
    `sizing.Distance`), up to the size field.

    Parameters
    ----------
    height : float
        Height of the first layer, in the unit of the domain.
    count : int
        Number of layers.
    growth : float
        Ratio of the heights of neighboring layers, at least 1.
    spacing : float, optional
        Largest width of the cells along the wall; by default the height of the last layer. OpenFOAM's `checkMesh`
        refuses cells that are more than 89 times as wide as high. Not for solids, where prisms are as wide as the
        cells beside them.
    edges : int, str, or sequence of them, optional
        Numbers or names of edges of the `Polygon`, of sides of the `Box`, or of patches of the `Solid`; by default all
        that are not periodic.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range, or `edges` are neither numbers nor names.

    Notes
    -----
    Where edges are at least 1.5 widths long, or all equal, each corner of the wall is a corner of cells, so no face on
    the wall is a sliver. Along shorter edges cells have the width `spacing`, independent of the corners of the wall.

    Columns become narrower towards corners where the wall turns away from the domain, such as trailing edges, down to 8
    heights of the first layer. The rows go around these corners. Columns are narrower on curved walls, too: between the
    two ends of a cell the wall leaves their chord by at most a quarter of the first layer's height. So `spacing` need
    not follow the radius of a nose.

    In a `Solid` the run meshes the whole solid. Then the polygons on the chosen patches move inwards by the thickness
    of all layers, inner vertices follow them over some cells, and prisms fill what is left free. Where a patch with
    layers meets one without at about a right angle, the sides of the prisms lie on that patch. Layers fill at most 0.25
    of a gap from each side, taper to nothing at other borders and at sharp edges, and are thinner where cells would be
    invalid: a warning says where, and ``settings["thickness"]`` of the result how thick they are. `n_cells` counts the
    cells without prisms, and `Adapter.memory_needed`, the memory of the device, does not depend on them. OpenFOAM's
    `checkMesh` refuses prisms that are more than 1000 times as wide as high.

    Examples
    --------
    >>> layers = clvoro.Layers(0.01, count=3, growth=1.2, edges=["yMin", "yMax"])
    >>> layers.heights.round(4).tolist(), round(layers.width, 4)
    ([0.01, 0.012, 0.0144], 0.0144)
    """

    height: float
    count: int = 1
    growth: float = 1.2
    spacing: float | None = None
    edges: Walls | None = None

    def __post_init__(self) -> None:
        check_number("Layers height", self.height, above=0)
        check_integer("Layers count", self.count, 1)
        check_number("Layers growth", self.growth, least=1)
        if self.spacing is not None:
            check_number("Layers spacing", self.spacing, above=0)
        if self.edges is not None:
            object.__setattr__(self, "edges", _numbers_or_names(self.edges))

    @property
    def heights(self) -> np.ndarray:
        """Heights of the layers, (count,)."""
        return self.height * self.growth ** np.arange(self.count)

    @property
    def thickness(self) -> float:
        """Height of all layers together; infinite if float64 overflows."""
        count, g = self.count, self.growth
        with np.errstate(over="ignore"):
            return float(self.height * (count if g == 1 else np.expm1(count * np.log(g)) / (g - 1)))

    @property
    def width(self) -> float:
        """Width of the cells along the wall."""
        if self.spacing is not None:
            return self.spacing
        with np.errstate(over="ignore"):
            return float(self.height * np.float64(self.growth) ** (self.count - 1))

    @property
    def rows(self) -> np.ndarray:
        """Distances of the generators from the wall, (count + 1,), whose bisectors are the borders of layers.

        A generator is at the share 1 / (1 + g) of its layer. The last row mirrors the one before at the last border.
        """
        tops = np.cumsum(self.heights)
        rows = tops - self.heights * (1 - 1 / (1 + self.growth))
        return np.append(rows, 2 * tops[-1] - rows[-1])


def _numbers_or_names(edges: object) -> tuple[int | str, ...]:
    """Return `edges` of `Layers` as a tuple."""
    items = [edges] if isinstance(edges, str | int | np.integer) else edges
    if isinstance(items, Mapping) or not isinstance(items, Iterable):
        raise InputTypeError(f"Layers edges is {edges!r}, expected numbers or names of edges")
    return tuple(e if isinstance(e, str) else check_integer("Layers edges", e, 0) for e in items)


class PlacedLayers:
    """The layers of a domain: rows of generators in 2D, prisms in a solid. This one has none."""

    points: np.ndarray
    """(n, d) float. Generators of layers, which do not move. Layers of prisms have none."""
    free: Domain
    """The part of the domain beyond the layers, in which all other generators move."""
    layers: Sequence[Layers] = ()
    compress = False
    """Whether the layers are made after a run, and other cells give up the room that they take."""

    def __init__(self, domain: Domain) -> None:
        self.free, self.points = domain, np.empty((0, domain.dim))

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (n, d) are beyond the layers, (n,) bool."""
        return np.ones(len(points), bool)

    def prisms(self, size: Size) -> float:
        """Return an estimate of the number of prisms, for wall polygons as wide as the size field."""
        del size
        return 0.0

    def narrow(self, size: Size) -> str:
        """Return where the default width of layers is smaller than the size field, in words; empty if nowhere."""
        del size
        return ""

    def mismatches(self, size: Size) -> list[str]:
        """Return warnings for cells of layers that have a very different size than the field there.

        Layers are usually finer than the field across the wall. But their width along the wall, if it is not given, can
        be far too small.
        """
        return [text for k in range(len(self.layers)) if (text := self._mismatch(k, size))]

    def _mismatch(self, k: int, size: Size) -> str:
        raise NotImplementedError


class LayerRows(PlacedLayers):
    """Layers along walls in 2D: rows of generators that do not move, in columns normal to the walls.

    - `polygon`: the domain.
    - `edges` (e, 2, 2) float: both ends of its oriented edges.
    - `chosen`, `chains` list of (e,) bool, list of list of Chain: for each of the layers, the edges that have it, and
      these joined.

    Raises `InputError` if an edge does not exist. Raises `InputTypeError` if the domain is neither a `Box` nor a
    `Polygon` in 2D.
    """

    def __init__(self, domain: Domain, layers: Sequence[Layers]) -> None:
        self.domain, self.layers = domain, layers
        self.polygon, numbers = _as_polygon(domain)
        oriented = self.polygon.oriented
        self.edges = np.stack([oriented.vertices, oriented.ends], axis=1)
        self.chosen = [np.isin(numbers, domain.boundaries.select("Layers edges", layer.edges)) for layer in layers]
        if not all(chosen.any() for chosen in self.chosen):
            raise InputError("Layers edges has only edges without length, expected one with a length")
        self.chains = [find_chains(self.polygon, chosen) for chosen in self.chosen]

    def count(self) -> int:
        """Return the number of generators that `points` begins with, without placing any.

        Raises `InputError` if the layers of one wall alone fill the domain.
        """
        total = 0
        for layer, chains in zip(self.layers, self.chains, strict=True):
            if not layer.thickness + _APART * layer.width < np.linalg.norm(self.domain.extent):
                raise InputError(_NO_ROOM)
            columns = sum(count_columns(chain, layer.width, layer.height) for chain in chains)
            total += columns * (layer.count + 1)
            total += sum(count_fan(chain, layer.width, y) for chain in chains for y in layer.rows)
        return total

    @cached_property
    def _columns(self) -> list[list[tuple[np.ndarray, np.ndarray]]]:
        """Feet and unit normals, (c, 2) each, of the columns of each chain of each of the layers."""
        return [
            [place_columns(chain, layer.width, layer.height) for chain in chains]
            for layer, chains in zip(self.layers, self.chains, strict=True)
        ]

    def columns(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return feet (c, 2) on the walls and unit normals (c, 2) of all columns of layer `k`."""
        feet, normals = zip(*self._columns[k], strict=True)
        return np.concatenate(feet), np.concatenate(normals)

    def segments(self, k: int) -> np.ndarray:
        """Return the edges that have layer `k`, (e, 2, 2): both ends of each."""
        return self.edges[self.chosen[k]]

    @cached_property
    def points(self) -> np.ndarray:
        """The generators, (n, 2).

        In corners and narrow gaps, where layers of several walls overlap, a generator is kept for its nearest wall.

        Raises `InputError` if none is in the domain.
        """
        found, limits, walls = [np.empty((0, 2))], [np.empty(0)], [np.empty(0)]
        for layer, chains, columns in zip(self.layers, self.chains, self._columns, strict=True):
            near = min(layer.width, layer.heights.min())
            for chain, (feet, normals) in zip(chains, columns, strict=True):
                for y in layer.rows:
                    fan = place_fan(chain, layer.width, y)
                    apart = chain.fan * y / max(len(fan) - 1, 1)
                    found += [feet + y * normals, fan]
                    limits += [np.full(len(feet), _NEAR * near), np.full(len(fan), _NEAR * min(near, apart))]
                    walls.append(np.full(len(feet) + len(fan), y))
        points, limit, wall = (np.concatenate(x) for x in (found, limits, walls))
        kept = self.polygon.contains(points)
        segments = np.concatenate([self.segments(k) for k in range(len(self.layers))])
        kept[kept] = _distances(points[kept], segments) >= _OWN * wall[kept]
        points, limit = points[kept], limit[kept]
        # In every chain the nearest rows to the wall come first. Of two generators too near, drop the later one.
        close = (
            scipy.spatial.KDTree(points).query_pairs(limit.max(), output_type="ndarray")
            if len(points)
            else np.empty((0, 2), int)
        )
        apart = np.hypot(*(points[close[:, 0]] - points[close[:, 1]]).T)
        close = close[apart < np.minimum(limit[close[:, 0]], limit[close[:, 1]])]
        gone = np.zeros(len(points), bool)
        for i, j in close[np.lexsort(close.T[::-1])].tolist():
            if not gone[i]:
                gone[j] = True
        points = points[~gone]
        if not len(points):
            raise InputError(
                f"layers of thickness {[layer.thickness for layer in self.layers]} do not fit between the walls of the "
                "domain; make them thinner"
            )
        return points

    def outer_segments(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts (m, 2, 2) of the last row of layer `k` between neighboring columns, and their widths (m,).

        Widths are their lengths, but at least `_NEAR` of that between the feet of the columns: in corners columns of
        two walls come close together. Parts that are outside of the domain, or nearer to another wall, are left out. If
        none is left, they are the edges with the layer.
        """
        layer, y = self.layers[k], float(self.layers[k].rows[-1])
        found, least = [np.empty((0, 2, 2))], [np.empty(0)]
        for chain, (feet, normals) in zip(self.chains[k], self._columns[k], strict=True):
            if chain.closed:
                feet, normals = (np.concatenate([x, x[:1]]) for x in (feet, normals))
            row, fan = feet + y * normals, place_fan(chain, layer.width, y)
            found += [np.stack([part[:-1], part[1:]], axis=1) for part in (row, fan)]
            least += [_NEAR * np.hypot(*np.diff(feet, axis=0).T), np.zeros(max(len(fan) - 1, 0))]
        segments = np.concatenate(found)
        widths = np.maximum(np.hypot(*(segments[:, 1] - segments[:, 0]).T), np.concatenate(least))
        middles, walls = segments.mean(axis=1), self.segments(k)
        kept = self.polygon.contains(middles)
        kept[kept] = _distances(middles[kept], walls) >= _OWN * y
        return (segments[kept], widths[kept]) if kept.any() else (walls, np.full(len(walls), layer.width))

    @cached_property
    def free(self) -> Domain:
        """The part of the domain beyond the layers, for generators that move; it has the frame of the domain.

        It begins a third of a width from the last row.

        Raises `InputError` if nothing is left.
        """
        domain = self.domain
        distances = [float(layer.rows[-1]) + _APART * layer.width for layer in self.layers]
        if domain.outline is None:
            corners = np.array([domain.lower, domain.upper])
            for layer, distance in zip(self.layers, distances, strict=True):
                for wall in domain.boundaries.select("Layers edges", layer.edges).tolist():
                    axis, end = divmod(wall, 2)
                    moved = (domain.lower, domain.upper)[end][axis] + (-distance if end else distance)
                    corners[end, axis] = (min if end else max)(corners[end, axis], moved)
            if not (corners[0] < corners[1]).all():
                raise InputError(_NO_ROOM)
            free = Box(tuple(corners[0]), tuple(corners[1]), domain.periodic)
            object.__setattr__(free, "framed_by", domain)
            return free
        # Merged to long lines first: the strips around thousands of short edges would overlap many times.
        lines = (shapely.union_all(np.asarray(shapely.linestrings(self.segments(k)))) for k in range(len(distances)))
        strips = [shapely.line_merge(line).buffer(distance) for line, distance in zip(lines, distances, strict=True)]
        left = self.polygon.geometry.difference(shapely.union_all(strips))
        # Where a strip ends beside a corner, an edge as short as round-off may remain.
        left = shapely.make_valid(shapely.remove_repeated_points(left, _SHORT * float(domain.extent.max())))
        every = [part for some in shapely.get_parts(left) for part in shapely.get_parts(some)]
        parts = [part for part in every if part.area > 1e-6 * domain.measure]
        if not parts:
            raise InputError(_NO_ROOM)
        inner = Polygon.from_shapely(shapely.MultiPolygon(parts))
        inner.framed_by = self.polygon
        return inner

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (n, 2) are in the `free` domain, and are no generators of layers, (n,) bool."""
        return np.asarray(self.free.contains(points) & (scipy.spatial.KDTree(self.points).query(points)[0] > 0))

    def check_gaps(self) -> None:
        """Refuse layers that are thicker than the gap between two walls along much of their length.

        In a narrow place, where layers of two walls overlap, each row is kept for its nearest wall. Layers that reach
        beyond the middle of a long gap give spikes.

        Raises `InputError` with the place of a narrow gap, and the largest thickness that fits there.
        """
        begin, end = self.edges.swapaxes(0, 1)
        thickness = np.zeros(len(begin))
        for layer, chosen in zip(self.layers, self.chosen, strict=True):
            thickness[chosen] = np.maximum(thickness[chosen], layer.rows[-1])
        for k, layer in enumerate(self.layers):
            feet, normals = self.columns(k)
            gaps, walls = _opposite(feet, normals, begin, end)
            needed = float(layer.rows[-1]) + np.where(walls >= 0, thickness[walls], 0.0)
            tight = needed > gaps
            if tight.mean() <= _TIGHT:
                continue
            # In sharp corners columns are in ever narrower gaps: a few of the narrowest are passed over.
            worst = int(np.argsort(gaps / needed, kind="stable")[int(_TIGHT / 2 * len(gaps))])
            fits = _FILLED * layer.thickness * gaps[worst] / needed[worst]
            raise InputError(
                f"layers[{k}] are {layer.thickness:.3g} thick, and the gap at {format_point(feet[worst])} is "
                f"{gaps[worst]:.3g} wide{', with layers on both sides' if thickness[walls[worst]] else ''}, expected a "
                f"thickness of at most {fits:.3g}; use fewer or thinner layers, or leave out these edges"
            )

    def narrow(self, size: Size) -> str:
        """See `PlacedLayers.narrow`."""
        found = []
        for k, layer in enumerate(self.layers):
            if layer.spacing is None:
                h = self._size_along(k, layer.count, size)
                if layer.width < NARROWER * h:
                    found.append(
                        f"layers[{k}] have cells {layer.width:.3g} wide, the last layer's height, where the size field "
                        f"is {h:.3g}: give spacing for others"
                    )
        return "; ".join(found)

    def _mismatch(self, k: int, size: Size) -> str:
        layer = self.layers[k]
        for row in sorted({0, layer.count - 1}):
            h, height = self._size_along(k, row, size), float(layer.heights[row])
            what = f"layers[{k}] has cells {layer.width:.3g} wide and {height:.3g} high where the size field is {h:.3g}"
            if np.sqrt(layer.width * height) > COARSER * h:
                return f"{what}: sizes jump there; make the layers finer or the size field larger along these walls"
            if row == layer.count - 1 and layer.spacing is None and layer.width < FINER * h:
                return (
                    f"{what}: their width is the last layer's height, because no spacing is given; do layers and size "
                    "field have the same unit? Otherwise give spacing, the width along the wall"
                )
        return ""

    def _size_along(self, k: int, row: int, size: Size) -> float:
        """Return the median size along row `row` of layer `k`; nan if that is outside of the domain."""
        feet, normals = self.columns(k)
        places = (feet + self.layers[k].rows[row] * normals)[:: -(-len(feet) // SAMPLE)]
        places = places[self.domain.contains(places)]
        return float(np.median(size(places))) if len(places) else np.nan


class LayerPrisms(PlacedLayers):
    """Layers along walls of a solid: prisms over the polygons on the walls, in the mesh for solvers.

    Raises `InputError` if layers are too many, a layer has a spacing, a patch has several layers, layers are thicker
    than the solid, or patches that meet have layers of different count.
    """

    free: Solid
    compress = True

    def __init__(self, solid: Domain, layers: Sequence[Layers]) -> None:
        self.layers, self.free, self.points = layers, cast("Solid", solid), np.empty((0, 3))
        boundaries = solid.boundaries
        self._chosen = [boundaries.select("Layers edges", layer.edges) for layer in layers]
        names = [solid.boundary_names[k] for k in solid.boundary_index]
        count = np.zeros(len(boundaries.index), np.int64)
        for k, (layer, walls) in enumerate(zip(layers, self._chosen, strict=True)):
            if layer.count > _MOST:
                raise InputError(f"layers[{k}] has count = {layer.count}, expected at most {_MOST}; use fewer layers")
            if layer.spacing is not None:
                raise InputError(
                    f"layers[{k}] has spacing = {layer.spacing:g}, expected none in a solid, where prisms are as wide "
                    "as the cells beside them; leave spacing out, and give the size field this value at the wall"
                )
            if not layer.thickness < np.linalg.norm(solid.extent) / 2:
                raise InputError(_NO_ROOM)
            if count[walls].any():
                raise InputError(
                    f"layers[{k}] are on {names[walls[count[walls] > 0][0]]!r}, which has other layers, expected one "
                    "of them for each patch; name other patches in edges"
                )
            count[walls] = layer.count
        meeting = count[solid.meeting_walls]
        wrong = np.flatnonzero((meeting > 0).all(axis=1) & (meeting[:, 0] != meeting[:, 1]))
        if wrong.size:
            one, other = (names[wall] for wall in solid.meeting_walls[wrong[0]].tolist())
            a, b = meeting[wrong[0]].tolist()
            raise InputError(
                f"layers have count {a} on {one!r} and {b} on {other!r}, which meet at a crease, expected one count; "
                f"give both count={max(a, b)}, with heights of your choice"
            )

    @cached_property
    def walls(self) -> list[Surface]:
        """The walls that have each of the layers."""
        return [cast("Surface", self.free.boundary(layer.edges)) for layer in self.layers]

    def sample(self, k: int, size: Size, most: int) -> np.ndarray:
        """Return `size` at up to `most` points on the walls of layer `k`, (m,) float."""
        return np.asarray(size(self.walls[k].landmarks(float(self.free.extent.min()) / 8, most)), float)

    def prisms(self, size: Size) -> float:
        """See `PlacedLayers.prisms`."""
        total = 0.0
        for k, layer in enumerate(self.layers):
            h, edges = self.sample(k, size, _SAMPLE), np.diff(self.walls[k].corners, axis=1).swapaxes(0, 1)
            area = float(np.linalg.norm(np.cross(*edges), axis=1).sum()) / 2
            total += layer.count * area * float((h**-2).mean())
        return total

    def compression(self, k: int, h: float) -> tuple[float, float]:
        """Return by which factor the prisms of layer `k` shrink the cells of size `h` near them, and to which depth.

        Prisms push vertices near walls inwards. Cells deeper below the walls stay as they are.
        """
        solid, layer = self.free, self.layers[k]
        depth = INNER_DEPTH * h + DEEPER * layer.thickness
        rows = np.flatnonzero(np.isin(solid.patch, self._chosen[k]))
        rows = rows[:: -(-len(rows) // _SAMPLE)]
        reach = np.full(len(rows), layer.thickness / OF_GAP)
        middles = solid.surface.corners[rows].mean(axis=1)
        room = solid.clearance(middles, -solid.normals[rows], reach, solid.patch[rows])
        thickness = float(np.minimum(layer.thickness, OF_GAP * room).mean())
        points = solid.lower + scipy.stats.qmc.Halton(3, scramble=False).random(_INSIDE) * solid.extent
        away2 = self.walls[k].distance2(points[solid.contains(points)])
        below = np.count_nonzero(away2 < depth**2)
        share = np.count_nonzero(away2 < thickness**2) / max(below, 1)
        return max((1 - share) ** (1 / 3), _LEAST_RATIO), depth

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (n, 3) are farther from the walls than the layers are thick, (n,) bool."""
        beyond = np.ones(len(points), bool)
        for walls, layer in zip(self.walls, self.layers, strict=True):
            beyond &= walls.distance2(points) > layer.thickness**2
        return beyond

    def _mismatch(self, k: int, size: Size) -> str:
        layer, h = self.layers[k], self.sample(k, size, SAMPLE)
        smallest, largest = float(h.min()), float(h.max())
        if layer.thickness > THICKEST * smallest:
            return (
                f"layers[{k}] are {layer.thickness:.3g} thick where the size field is {smallest:.3g}, expected at most "
                f"{THICKEST:g} times as much, as all cells beside them are compressed; use fewer or thinner layers"
            )
        if largest > FLATTEST * layer.height:
            return (
                f"layers[{k}] have a first height of {layer.height:.3g} where the size field is {largest:.3g}: "
                f"OpenFOAM's checkMesh rejects cells more than {FLATTEST:g} times as wide as high; use a larger "
                "height, or smaller sizes there"
            )
        if layer.heights[-1] < THINNEST * smallest:
            return (
                f"the last of layers[{k}] is {layer.heights[-1]:.3g} high beside cells of {smallest:.3g}, where sizes "
                "jump; use more layers, or a larger growth"
            )
        return ""


def _as_polygon(domain: Domain) -> tuple[Polygon, np.ndarray]:
    """Return a domain in 2D as a polygon, and the number in `domain` of each of its oriented edges."""
    if domain.outline is not None:
        return domain.outline, domain.outline.oriented.edge_numbers
    if domain.dim != 2 or all(domain.periodic):
        hint = "; write clvoro.Solid.box(lower, upper)" if domain.plain else ""
        raise InputTypeError(
            f"layers are for a Box with walls or a Polygon in 2D, and for a Solid, not for {domain}{hint}"
        )
    (a, b), (c, d) = domain.lower, domain.upper
    return Polygon([(a, b), (c, b), (c, d), (a, d)]), np.array([2, 1, 3, 0])


def _distances(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return the distance of each of the points (n, 2) from the nearest segment, (k, 2, 2)."""
    tree = shapely.STRtree(np.asarray(shapely.linestrings(segments)))
    return tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)[1]


def _opposite(
    feet: np.ndarray, normals: np.ndarray, begin: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each foot (c, 2) how far its normal goes to a wall that faces it, (c,), and that wall, -1 if none."""
    along = end - begin
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.hypot(*along.T), 1e-300)[:, None]
    reach = float(np.ptp(begin, axis=0).max()) * 2
    lines = shapely.linestrings(np.stack([feet, feet + reach * normals], axis=1))
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.stack([begin, end], axis=1))))
    column, wall = tree.query(np.asarray(lines), predicate="intersects")
    facing = (inward[wall] * normals[column]).sum(axis=1) < _FACING
    column, wall = column[facing], wall[facing]
    away = ((begin[wall] - feet[column]) * inward[wall]).sum(axis=1)
    away /= (normals[column] * inward[wall]).sum(axis=1)
    gaps, walls = np.full(len(feet), np.inf), np.full(len(feet), -1)
    order = np.argsort(-away, kind="stable")
    gaps[column[order]], walls[column[order]] = away[order], wall[order]
    return gaps, walls
