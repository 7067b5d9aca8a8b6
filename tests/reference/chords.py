"""Chords of one line along a boundary: which points they keep, and what they cost, point by point."""

from itertools import pairwise
from math import atan2, hypot, inf, pi

Point = tuple[float, float]
SIDE_TURN = pi / 6 * (1 + 2.0**-10)


def turn(a: Point, b: Point, c: Point) -> float:
    """The angle by which the way from a over b to c turns to the left."""
    x, y, u, v = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    return atan2(x * v - y * u, x * u + y * v)


def offset(a: Point, b: Point, c: Point) -> tuple[float, float]:
    """The distance of b from the segment between a and c, and the area of the triangle, negative for a right turn."""
    x, y, u, v = c[0] - a[0], c[1] - a[1], b[0] - a[0], b[1] - a[1]
    square, along, left = x * x + y * y, x * u + y * v, u * y - v * x
    if 0 < along < square:
        return abs(left) / square**0.5, left / 2
    return (hypot(u, v) if along <= 0 else hypot(u - x, v - y)), left / 2


def area(line: list[Point]) -> float:
    """The area to the left of a line and to the right of its chord."""
    x, y = line[0]
    moved = [(p - x, q - y) for p, q in line]
    return sum(p * v - q * u for (p, q), (u, v) in pairwise(moved)) / 2


def kept(line: list[Point], fixed: list[bool], size: float) -> list[int]:
    """The points between which chords run; `fixed` says of each point whether it remains in any case."""
    left, turned = [0], 0.0
    for i in range(1, len(line) - 1):
        turned += turn(*line[i - 1 : i + 2])
        if fixed[i] or abs(turned) > SIDE_TURN:
            left.append(i)
            turned = 0.0
    left += [len(line) - 1] * (len(line) > 1)

    def far(k: int) -> float:
        if k in (0, len(left) - 1) or fixed[left[k]]:
            return inf
        distance, beside = offset(line[left[k - 1]], line[left[k]], line[left[k + 1]])
        return inf if distance >= (0.25 if beside < 0 else 0.03) * size else distance

    while True:
        offsets = [far(k) for k in range(len(left))]
        drop = [k for k in range(1, len(left) - 1) if offsets[k] < offsets[k - 1] and offsets[k] <= offsets[k + 1]]
        if not drop:
            break
        left = [p for k, p in enumerate(left) if k not in drop]
    while True:
        lost = area(line) - area([line[i] for i in left])
        choice = []
        for k in range(1, len(left) - 1):
            distance, beside = offset(line[left[k - 1]], line[left[k]], line[left[k + 1]])
            if distance <= 0.25 * size and not fixed[left[k]]:
                choice.append((abs(lost + beside), k))
        if not choice or min(choice)[0] >= abs(lost):
            return left
        del left[min(choice)[1]]


def cost(line: list[Point], left: list[int], size: float, centroid: Point) -> float:
    """The cost of the chords between the points `left`."""
    total = 0.0
    for first, last in pairwise(left):
        a, c = line[first], line[last]
        total += abs(area(line[first : last + 1]))
        offsets = [(offset(a, b, c)[0], -k) for k, b in enumerate(line[first + 1 : last])]
        if offsets:
            off, k = max(offsets)
            total += 0.2 * off * size
            total += 0.1 * size**2 * (off > 0 and turn(a, line[first + 1 - k], c) < -pi / 3)
        total += 0.02 * size**2 * (hypot(c[0] - a[0], c[1] - a[1]) < 0.1 * size)
        total += 0.1 * size**2 * max(skewness(a, c, centroid) - 1, 0) ** 2
    return total


def skewness(a: Point, b: Point, centroid: Point) -> float:
    """OpenFOAM's skewness of a wall face from a to b."""
    x, y = b[0] - a[0], b[1] - a[1]
    length = hypot(x, y)
    u, v = (a[0] + b[0]) / 2 - centroid[0], (a[1] + b[1]) / 2 - centroid[1]
    off, height = abs(x * u + y * v) / length, abs(x * v - y * u) / length
    return off / max(length / 2, 0.4 * height)


def concave_price(way: list[Point], size: float) -> float:
    """The price for corners on a way, without its ends, that are not convex."""
    turns = [turn(*way[k - 1 : k + 2]) for k in range(1, len(way) - 1)]
    return size**2 * sum(0.5 * (0.1 + min(-t, 1.0)) for t in turns if t < 1e-4)
