"""Evaluation of h and of the gradient of log h at points on the device (`size_field.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..arguments import format_point
from ..errors import SizeFieldError
from ..geometry.domain import Domain
from ..opencl.engine import Engine
from .arguments import advice_for_size
from .codegen import generate_code
from .field import Constant, Field, as_field, on_domain

_ALL_VALID = np.iinfo(np.int32).max

MAX_SIZE = 1e9
"""Largest h over the domain's unit of length: for larger ones the error (L - h) / L and h^-5 are not in range of
float32."""

BATCH = 1 << 16
"""Points on the host that are evaluated at once. More points take more memory and no less time."""

# Central differences of step s = c h have the round-off error eps / (2 c h) and the truncation error (c h)^2 h''' / 6.
# In float32 round-off dominates, so the step is 5 % of a cell; dh/dx is then accurate to 1e-3 for cells down to 1/1000
# of the domain. In float64 both errors are below 1e-7.
_GRADIENT_STEP = {np.dtype(np.float64): 1e-3, np.dtype(np.float32): 5e-2}


class Sizing:
    """A size field on a domain, ready to be evaluated on the device.

    All lengths on the device are the normalized ones of `domain.frame`: x' = (x - origin) / scale,
    h' = h / scale.

    Parameters
    ----------
    engine : Engine
    domain : Box, Polygon, Sphere or Solid
    field : Field, number or callable
        A callable is evaluated on the host, and so is a combination of a callable with other fields: each evaluation
        then copies the points to the host and the sizes back.
    gradient_step : float, optional
        Step of the differences for dh/dx, over h; the default depends on the precision.

    Attributes
    ----------
    field : Field
    prelude : str or None
        OpenCL text of `size_at` for other kernels (see `generate_code`); None if the field runs on the host.
    data : device array of real, or None
        The argument `data` of `size_at`.

    Raises
    ------
    InputError
        If the dimensions of field and domain differ.
    """

    def __init__(self, engine: Engine, domain: Domain, field: object, gradient_step: float | None = None):
        self.engine, self.domain, self.field = engine, domain, on_domain(domain, as_field(field))
        self.field.check_dim(domain.dim)
        self._origin, self._scale = domain.frame
        self._walls = (np.array([domain.lower, domain.upper]) - self._origin) / self._scale
        self._gradient_step = gradient_step
        self.prelude, self.data, self._kernels = None, None, None
        self._parts: list[Sizing] = []
        self._peak_bytes = 0
        if self.field.on_device:
            self.prelude, numbers, self._peak_bytes = generate_code(self.field, domain, engine.real, engine)
            self.data = engine.upload(numbers)
            self._invalid = engine.upload([_ALL_VALID], np.int32)
            step = self._step(engine.real)
            self._kernels = engine.kernels(
                "sizing/size_field",
                defines={"GRADIENT_STEP": repr(step), "MAX_SIZE": repr(MAX_SIZE)},
                prelude=self.prelude,
            )
        else:
            # A callable is evaluated in float64, the fields that it is combined with in the device's precision.
            self._host_step = self._step(np.float64)
            self._host_field = self._with_device_parts(self.field)

    def on(self, engine: Engine) -> Sizing:
        """Return the same on another engine."""
        return Sizing(engine, self.domain, self.field, self._gradient_step)

    def _step(self, real: object) -> float:
        """Return the step of the differences over h."""
        own = _GRADIENT_STEP[np.dtype(real)]  # type: ignore[call-overload]
        return own if self._gradient_step is None else self._gradient_step

    @property
    def real(self) -> np.dtype:
        """The device's precision."""
        return self.engine.real

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the field's landmarks (see `Field.landmarks`)."""
        return self.field.landmarks(domain)

    def evaluate(self, points: cla.Array, n: int, h_out: cla.Array, factor: float = 1.0) -> None:
        """Write `factor` h' at the first `n` of `points` (>= n, d) into `h_out` (>= n,).

        The next `check` raises if a value of h is not positive and finite. A field on the host raises at once.
        """
        real = self.engine.real.type
        if self._kernels is None:
            h = self._on_host(self._physical(points[:n].get())) / self._scale
            h_out[:n].set(real(factor) * h.astype(self.engine.real))
            return
        self.engine.run_each(self._kernels.evaluate_size, n, points, self.data, real(factor), h_out, self._invalid)

    def evaluate_with_gradient(self, points: cla.Array, n: int, h_out: cla.Array, grad_out: cla.Array) -> None:
        """Write h' into `h_out` (>= n,) and the normalized grad log h into `grad_out` (>= n, d).

        Central differences over a small share of h. Both sample points stay inside the domain's bounding box.
        """
        if self._kernels is None:
            x = points[:n].get().astype(float)
            h = self._on_host(self._physical(x)) / self._scale
            step = self._host_step * h
            gradient = np.zeros_like(x)
            for a in range(x.shape[1]):
                ahead, behind = x.copy(), x.copy()
                ahead[:, a] = np.minimum(x[:, a] + step, self._walls[1, a])
                behind[:, a] = np.maximum(x[:, a] - step, self._walls[0, a])
                for way in (ahead, behind):
                    out = ~self.domain.contains(self._physical(way))
                    way[out] = x[out]
                rise = self._on_host(self._physical(ahead)) - self._on_host(self._physical(behind))
                rise /= self._scale
                run = ahead[:, a] - behind[:, a]
                np.divide(rise, run * h, out=gradient[:, a], where=run > 0)
            h_out[:n].set(h.astype(self.engine.real))
            grad_out[:n].set(gradient.astype(self.engine.real))
            return
        given = points, self.data, *self.domain.device_args(self.engine)
        self.engine.run_each(self._kernels.evaluate_size_gradient, n, *given, h_out, grad_out, self._invalid)

    @property
    def invalid_index(self) -> cla.Array | None:
        """The integer on the device that `check` reads: the first point with an invalid size. None on the host."""
        return None if self._kernels is None else self._invalid

    def check(self, points: cla.Array, h: cla.Array, factor: float = 1.0, first: int | None = None) -> None:
        """Raise if an evaluation since the last check gave a value that is not positive and finite.

        Parameters
        ----------
        points, h, factor : device arrays, and float
            Those of the last evaluation; `h` includes `factor`.
        first : int, optional
            Content of `invalid_index`, if the caller has read it.

        Raises
        ------
        SizeFieldError
            With the point, in physical coordinates, and the value.
        """
        if self._kernels is None:
            return
        first = int(self._invalid.get()[0]) if first is None else first
        if first == _ALL_VALID:
            return
        self._invalid.fill(np.int32(_ALL_VALID))
        place = self._physical(points[first : first + 1].get())[0]
        raise self._error(place, float(h[first : first + 1].get()[0]) / factor * self._scale)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return h (n,) float64 at physical `points` (n, d) on the host, computed on the device.

        Raises `SizeFieldError` if a value is not positive and finite.
        """
        if self._kernels is None:
            return self._on_host(np.asarray(points, dtype=float))
        return self._values(np.asarray(points, dtype=float), check=True)

    def _physical(self, normalized: np.ndarray) -> np.ndarray:
        """Return physical coordinates, clipped to the domain's bounding box because of round-off."""
        x = normalized.astype(float) * self._scale + self._origin
        return np.clip(x, self.domain.lower, self.domain.upper)

    def _with_device_parts(self, field: Field) -> Field:
        """Return a host field whose parts with a device form are evaluated on the device."""
        if isinstance(field, Constant):
            return field
        if field.on_device:
            self._host_step = self._step(self.engine.real)
            self._parts.append(Sizing(self.engine, self.domain, field))
            return _DevicePart(self._parts[-1])
        return field.map_parts(self._with_device_parts)

    @property
    def device_bytes(self) -> int:
        """Device memory of the field, in bytes."""
        own = 0 if self.data is None else self.data.nbytes
        return own + sum(part.device_bytes for part in self._parts)

    @property
    def peak_bytes(self) -> int:
        """Largest device memory so far, in bytes, evaluations at points on the host included."""
        return max(
            self._peak_bytes,
            *(self.device_bytes - p.device_bytes + p.peak_bytes for p in self._parts),
            self.device_bytes,
        )

    def bytes_for(self, n: int) -> int:
        """Return the additional device memory for an evaluation at `n` generators, in bytes."""
        each = (self.domain.dim + 1) * self.real.itemsize
        return min(n, BATCH) * each if self._parts else 0

    def _values(self, points: np.ndarray, check: bool = False) -> np.ndarray:
        """Return h at physical `points`, computed on the device. Without `check` any numbers are valid."""
        found = np.empty(len(points))
        for first in range(0, len(points), BATCH):
            part = slice(first, first + BATCH)
            normalized = (points[part] - self._origin) / self._scale
            x, h = self.engine.upload(normalized), self.engine.empty(len(normalized))
            self._peak_bytes = max(self._peak_bytes, self.device_bytes + x.nbytes + h.nbytes)
            self.evaluate(x, len(normalized), h)
            if check:
                self.check(x, h)
            found[part] = h.get().astype(float) * self._scale
            del x, h  # free the memory before the next batch
        return found

    def _on_host(self, points: np.ndarray) -> np.ndarray:
        sizes = self._host_field(points)
        self._check_sizes(points, sizes)
        return sizes

    def _check_sizes(self, points: np.ndarray, sizes: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            working = (sizes / self._scale).astype(self.engine.real)
        bad = np.flatnonzero(~((working > 0) & (working <= MAX_SIZE)))
        if bad.size:
            raise self._error(points[bad[0]], float(sizes[bad[0]]))

    def _error(self, place: np.ndarray, value: float) -> SizeFieldError:
        most = MAX_SIZE * self._scale
        return SizeFieldError(
            f"the size field {self.field!r} is {value:g} at {format_point(place)}, expected a positive, finite "
            f"size on the whole domain, at most {most:.3g} here; "
            f"{advice_for_size(value, self.domain, self.field.on_device, most)}"
        )


class _DevicePart(Field):
    """A part of a host field that is evaluated on the device; its values need not be positive."""

    def __init__(self, stage: Sizing):
        self._stage, self.dim = stage, stage.field.dim

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self._stage._values(points)
