"""Which part owns which generators: successive blocks of a Hilbert curve. All parts find the same blocks."""

from __future__ import annotations

from functools import cache

import numpy as np

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.peers import Peers

BITS = 20
"""Bits of a coordinate in the keys of the Hilbert curve."""
BLOCKS = 1024
"""A block has at most the share 1 / `BLOCKS` of all generators, unless many are at one place."""
UNBALANCED = 1.1
"""Ratio of the largest number of generators of a part to the mean beyond which parts are divided anew."""


def hilbert_keys(points: np.ndarray, lower: np.ndarray, upper: np.ndarray, bits: int = BITS) -> np.ndarray:
    """Return the places along a Hilbert curve of `points` (n, d) in the box between two corners, (n,) uint64.

    Keys have this number of `bits` of each coordinate.

    The transformation is that of Skilling (2004), AIP Conf. Proc. 707, 381.
    """
    d, one = points.shape[1], np.uint32(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = np.nan_to_num((points - lower) / (upper - lower))
    x = list(np.clip(unit * 2.0**bits, 0, 2.0**bits - 1).T.astype(np.uint32, order="C"))
    for bit in map(np.uint32, range(bits - 1, 0, -1)):
        p = (one << bit) - one
        for a in range(d):
            flips = -(x[a] >> bit & one) & p
            t = (x[0] ^ x[a]) & (flips ^ p)
            x[0] ^= flips | t
            if a:
                x[a] ^= t
    for a in range(1, d):
        x[a] ^= x[a - 1]
    t = np.zeros(len(points), np.uint32)
    for bit in map(np.uint32, range(bits - 1, 0, -1)):
        t ^= -(x[-1] >> bit & one) & ((one << bit) - one)
    half = (bits + 1) // 2
    numbers, low = np.arange(2**half, dtype=np.uint64), np.uint32(2**half - 1)
    spread = sum((numbers >> np.uint64(b) & np.uint64(1)) << np.uint64(d * b) for b in range(half))
    keys = np.zeros(len(points), np.uint64)
    for a in range(d):
        x[a] ^= t
        wide = spread[x[a] & low] | spread[x[a] >> np.uint32(half)] << np.uint64(d * half)
        keys |= wide << np.uint64(d - 1 - a)
    return keys


@cache
def _curve(dim: int) -> np.ndarray:
    """Return the places along a Hilbert curve of the cells of a grid, row by row; the grid has at most 2^16 cells."""
    side = 2 ** (16 // dim)
    cells = np.indices((side,) * dim).reshape(dim, -1).T
    return hilbert_keys(cells, np.zeros(dim), np.full(dim, side), 16 // dim).astype(np.uint16)


def coarse_keys(axes: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return short `hilbert_keys` of n points, (n,) uint16, with ``16 // d`` bits for each coordinate.

    `axes` (d, n) are the coordinates of the points, one row for each axis. The keys are the first bits of
    longer keys, and take a tenth of the time.
    """
    dim, n = axes.shape
    side, cells = 2 ** (16 // dim), np.zeros(n, np.int32)
    for x, begin, end in zip(axes, lower, upper, strict=True):
        along = ((x - begin) * (side / (end - begin))).astype(np.int32)
        cells = cells * side + np.clip(along, 0, side - 1, out=along)
    return _curve(dim)[cells]


def divide(keys: np.ndarray, dim: int, peers: Peers, bits: int = BITS) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the first keys of blocks of the curve, (b,), and how many generators all parts have in each.

    Blocks depend on the generators alone, not on the number of parts. `keys` (n,) are those of this part, with this
    number of `bits` of each coordinate. The last value is whether the keys are long enough for small blocks.
    """
    keys = np.sort(keys)
    firsts, spans = np.zeros(1, keys.dtype), np.full(1, dim * bits)
    most = max(int(peers.total(len(keys))) // BLOCKS, 1)
    while True:
        begins = np.searchsorted(keys, firsts)
        counts = peers.total(np.diff(np.append(begins, len(keys))))
        large = counts > most
        full = large & (spans > 0)
        if not full.any():
            return firsts, counts, not large.any()
        step = np.where(full, spans - dim, 0).astype(keys.dtype)[full]
        children = firsts[full][:, None] + (np.arange(2**dim, dtype=keys.dtype) << step[:, None])
        levels = np.repeat(spans[full] - dim, 2**dim)
        firsts, spans = np.concatenate([firsts[~full], children.ravel()]), np.concatenate([spans[~full], levels])
        order = np.argsort(firsts, kind="stable")
        firsts, spans = firsts[order], spans[order]


def owners_of(counts: np.ndarray, parts: int) -> np.ndarray:
    """Return the part that owns each block, (b,) uint16.

    Parts own runs of blocks with nearly equal numbers of generators; `counts` (b,) are those of the blocks.
    """
    middle = np.cumsum(counts) - counts / 2
    return np.minimum(middle * parts / max(counts.sum(), 1), parts - 1).astype(np.uint16)


def is_balanced(n: int, peers: Peers) -> bool:
    """Return whether no part has many more generators than the mean; this one has `n`."""
    sizes = np.array(peers.gather(np.array(n)))
    return bool(sizes.max() <= UNBALANCED * sizes.mean() and sizes.min() > 0)


def distribute(engine: Engine, box: ClipBox, rows: dict) -> dict:
    """Send generators to the parts that own them from now on, and return the new arrays of this part by name.

    `rows` are its present arrays on the device. They are freed. ``rows["points"]`` are in the device's coordinates in
    `box`. All parts call this together.
    """
    peers = engine.peers
    lower, upper = (corner[: engine.dim].astype(float) for corner in box.device_corners(engine.real))
    x, bits = rows["points"].get(), 16 // engine.dim
    keys = coarse_keys(np.ascontiguousarray(x.T), lower, upper)
    firsts, counts, enough = divide(keys, engine.dim, peers, bits)
    if enough:
        to = owners_of(counts, peers.count).repeat(np.diff(firsts.astype(int), append=2 ** (engine.dim * bits)))[keys]
    else:
        keys = hilbert_keys(x.astype(float), lower, upper)
        firsts, counts, _ = divide(keys, engine.dim, peers)
        to = owners_of(counts, peers.count)[np.searchsorted(firsts, keys, side="right") - 1]
    order, ends, made = np.argsort(to, kind="stable"), np.cumsum(np.bincount(to, minlength=peers.count)), {}
    for name in list(rows):
        found = np.concatenate(peers.exchange(np.split(rows.pop(name).get()[order], ends[:-1])))
        made[name] = engine.upload(found, found.dtype)
    return made
