"""What makes a run, as plain values: by them a checkpoint knows its own run from others."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np

from ..geometry.box import Domain
from ..geometry.polygon import Polygon


def describe(
    domain: Domain, options: dict[str, Any], dtype: np.dtype, points: np.ndarray | None
) -> dict:
    """Return what makes a run, as plain values: a checkpoint of other ones is refused."""
    start = None if points is None else hashlib.sha256(np.ascontiguousarray(points).tobytes())
    return {
        "domain": identity(domain),
        "dtype": dtype.name,
        "points": None if start is None else start.hexdigest(),
        **options,
        "layers": [repr(layer) for layer in options["layers"]],
    }


def identity(domain: Domain) -> dict[str, Any]:
    """Return what tells `domain` from others, and what the arrays of a file have to fit."""
    described = json.dumps(domain.describe(), sort_keys=True)
    return {
        "kind": type(domain).__name__,
        "lower": list(domain.lower),
        "upper": list(domain.upper),
        "periodic": list(domain.periodic),
        "walls": len(domain.oriented.vertices) if isinstance(domain, Polygon) else 2 * domain.dim,
        "digest": hashlib.sha256(described.encode()).hexdigest(),
    }


def named(identity: Any) -> str:
    """Return a domain as errors call it, by its `identity` or what a file has in its place."""
    if not isinstance(identity, dict):
        return repr(identity)
    told = {key: value for key, value in identity.items() if key not in ("kind", "digest")}
    return f"{identity.get('kind')}({told}, {identity.get('digest')!s:.8}...)"
