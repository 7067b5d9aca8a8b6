"""Fingerprints: plain values that identify a run, its domain and its schedule, for checkpoints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..geometry.domain import Domain


def run_fingerprint(
    domain: Domain, options: dict[str, Any], dtype: np.dtype, points: np.ndarray | None, fixed: np.ndarray | None = None
) -> dict[str, Any]:
    """Return plain values that identify a run. A checkpoint of another run is rejected."""
    return {
        "domain": domain_fingerprint(domain),
        "dtype": dtype.name,
        "points": None if points is None else _digest(points),
        "fixed": _digest(fixed) if fixed is not None and len(fixed) else None,
        **options,
        "layers": [repr(layer) for layer in options["layers"]],
    }


def _digest(positions: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(positions).tobytes()).hexdigest()


def domain_fingerprint(domain: Domain) -> dict[str, Any]:
    """Return plain values that identify `domain` and determine the shapes of a file's arrays."""
    described = json.dumps(domain.describe(), sort_keys=True)
    return {
        "kind": type(domain).__name__,
        "lower": list(domain.lower),
        "upper": list(domain.upper),
        "periodic": list(domain.periodic),
        "walls": len(domain.boundary_index),
        "digest": hashlib.sha256(described.encode()).hexdigest(),
    }


def domain_name(fingerprint: Any) -> str:
    """Return a domain as it appears in errors, from its fingerprint or from any other value in its place."""
    if not isinstance(fingerprint, dict):
        return repr(fingerprint)
    shown = {key: value for key, value in fingerprint.items() if key not in ("kind", "digest")}
    return f"{fingerprint.get('kind')}({shown}, {fingerprint.get('digest')!s:.8}...)"


def schedule_digest(schedule: Sequence[object]) -> str:
    """Return a hash of a schedule that has not begun."""
    return hashlib.sha256(repr(schedule).encode()).hexdigest()
