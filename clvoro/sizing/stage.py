"""The stage: h, and the gradient of log h, at points on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import SizeFieldError
from .bind import bind
from .field import Constant, Field, as_field
from .remedy import remedy_for

if TYPE_CHECKING:
    import pyopencl.array as cla

    from ..geometry.box import Domain
    from ..opencl.program import Engine

_NONE_BAD = np.iinfo(np.int32).max

MOST_SIZE = 1e9
"""Largest h over the domain's unit of length: beyond, the error (L - h) / L and h^-5 leave float32."""

AT_ONCE = 1 << 16
"""Points of the host's whose sizes are evaluated at once: more take no less time, and memory."""

# Central differences of step s = c h: rounding of h, about eps, shows as eps / (2 c h) in dh/dx,
# the curvature of h as (c h)^2 h''' / 6. In float32 rounding rules, so the step is wide: 5 % of a
# cell; dh/dx is then good to 1e-3 for cells down to 1/1000 of the domain. In float64 both are below
# 1e-7.
_GRADIENT_STEP = {np.dtype(np.float64): 1e-3, np.dtype(np.float32): 5e-2}


class Sizing:
    """A size field on a domain, ready to be evaluated on the device.

    All lengths on the device are the normalized ones of `domain.frame`: x' = (x - origin) / scale,
    h' = h / scale.

    Parameters
    ----------
    engine : Engine
    domain : Domain
    field : Field, number or callable
        A callable is evaluated on the host, and so is the combination of a callable with other
        fields: each evaluation then moves the points to the host and the sizes back.
    gradient_step : float, optional
        Step of the differences that give dh/dx, over h; by default what suits the precision.

    Attributes
    ----------
    field : Field
    prelude : str or None
        OpenCL text of `size_at` for other stages (see `bind`); None if the field lives on the host.
    data : device array of real, or None
        The argument `data` of `size_at`.

    Raises
    ------
    InputError
        If the field is of another dimension than the domain.
    """

    def __init__(
        self, engine: Engine, domain: Domain, field: object, gradient_step: float | None = None
    ):
        self.engine, self.domain, self.field = engine, domain, as_field(field)
        self.field.check_dim(domain.dim)
        self._origin, self._scale = domain.frame
        self._walls = (np.array([domain.lower, domain.upper]) - self._origin) / self._scale
        self._gradient_step = gradient_step
        self.prelude, self.data, self._kernels = None, None, None
        self._parts: list[Sizing] = []
        self._taken = 0
        if self.field.on_device:
            self.prelude, numbers, self._taken = bind(self.field, domain, engine.real, engine)
            self.data = engine.upload(numbers)
            self._bad = engine.upload([_NONE_BAD], np.int32)
            step = self._step(engine.real)
            self._kernels = engine.kernels(
                "sizing/size_field", defines={"GRADIENT_STEP": repr(step), "MOST_SIZE": repr(MOST_SIZE)},
                prelude=self.prelude,
            )  # fmt: skip
        else:
            # The callable itself is exact in float64; its fellows are not, if the device is not.
            self._host_step = self._step(np.float64)
            self._host_field = self._with_device_parts(self.field)

    def _step(self, real: object) -> float:
        """Step of the differences over h."""
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

        A value of h that is not positive and finite is noted, and raised by the next `check`; on the
        host at once.
        """
        real = self.engine.real.type
        if self._kernels is None:
            h = self._on_host(self._physical(points[:n].get())) / self._scale
            h_out[:n].set(real(factor) * h.astype(self.engine.real))
            return
        self.engine.run_each(
            self._kernels.evaluate, n, points, self.data, real(factor), h_out, self._bad
        )

    def evaluate_with_gradient(
        self, points: cla.Array, n: int, h_out: cla.Array, grad_out: cla.Array
    ) -> None:
        """Write h' into `h_out` (>= n,) and the normalized grad log h into `grad_out` (>= n, d).

        Central differences over a small part of h; both sample points stay inside the domain's
        bounding box.
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
        self.engine.run_each(
            self._kernels.evaluate_with_gradient, n, points, self.data,
            *self.domain.device_args(self.engine), h_out, grad_out, self._bad,
        )  # fmt: skip

    @property
    def noted(self) -> cla.Array | None:
        """What `check` reads, one integer, if there is anything to read."""
        return None if self._kernels is None else self._bad

    def check(
        self, points: cla.Array, h: cla.Array, factor: float = 1.0, first: int | None = None
    ) -> None:
        """Raise if an evaluation since the last check met a value that is not positive and finite.

        Reads one integer from the device, unless the caller has: `first`, from `noted`. `points` and `h` are those of
        the last evaluation, `h` times `factor`.

        Raises
        ------
        SizeFieldError
            Naming the place, in physical coordinates, and the value.
        """
        if self._kernels is None:
            return
        first = int(self._bad.get()[0]) if first is None else first
        if first == _NONE_BAD:
            return
        self._bad.fill(np.int32(_NONE_BAD))
        place = self._physical(points[first : first + 1].get())[0]
        raise self._error(place, float(h[first : first + 1].get()[0]) / factor * self._scale)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return h at physical `points` (n, d), host to host, (n,) float64, by the device.

        Raises
        ------
        SizeFieldError
            If a value is not positive and finite.
        """
        if self._kernels is None:
            return self._on_host(np.asarray(points, dtype=float))
        return self._values(np.asarray(points, dtype=float), check=True)

    def _physical(self, normalized: np.ndarray) -> np.ndarray:
        """Return physical coordinates, kept inside the domain's bounding box against rounding."""
        x = normalized.astype(float) * self._scale + self._origin
        return np.clip(x, self.domain.lower, self.domain.upper)

    def _with_device_parts(self, field: Field) -> Field:
        """Return a field of the host with the parts that have a device form on the device."""
        if isinstance(field, Constant):
            return field
        if field.on_device:
            self._host_step = self._step(self.engine.real)
            self._parts.append(Sizing(self.engine, self.domain, field))
            return _DevicePart(self._parts[-1])
        return field.with_parts(self._with_device_parts)

    @property
    def held(self) -> int:
        """Bytes that the field has on the device."""
        own = 0 if self.data is None else self.data.nbytes
        return own + sum(part.held for part in self._parts)

    @property
    def taken(self) -> int:
        """Bytes that it has taken there at most so far, for points of the host's."""
        return max(self._taken, *(self.held - p.held + p.taken for p in self._parts), self.held)

    def taken_for(self, n: int) -> int:
        """Return the bytes that evaluating it at `n` generators takes, beside what it holds."""
        each = (self.domain.dim + 1) * self.real.itemsize
        return min(n, AT_ONCE) * each if self._parts else 0

    def _values(self, points: np.ndarray, check: bool = False) -> np.ndarray:
        """Return h at physical `points` by the device; they need not be sizes where nobody is to `check`."""
        found = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            normalized = (points[part] - self._origin) / self._scale
            x, h = self.engine.upload(normalized), self.engine.empty(len(normalized))
            self._taken = max(self._taken, self.held + x.nbytes + h.nbytes)
            self.evaluate(x, len(normalized), h)
            if check:
                self.check(x, h)
            found[part] = h.get().astype(float) * self._scale
            del x, h  # before there are others
        return found

    def _on_host(self, points: np.ndarray) -> np.ndarray:
        sizes = self._host_field(points)
        self._refuse(points, sizes)
        return sizes

    def _refuse(self, points: np.ndarray, sizes: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            working = (sizes / self._scale).astype(self.engine.real)
        bad = np.flatnonzero(~((working > 0) & (working <= MOST_SIZE)))
        if bad.size:
            raise self._error(points[bad[0]], float(sizes[bad[0]]))

    def _error(self, place: np.ndarray, value: float) -> SizeFieldError:
        where, most = ", ".join(f"{c:.6g}" for c in place), MOST_SIZE * self._scale
        return SizeFieldError(
            f"the size field {self.field!r} is {value:g} at ({where}), expected a positive, finite "
            f"size on the whole domain, at most {most:.3g} here; "
            f"{remedy_for(value, self.domain, self.field.on_device, most)}"
        )


class _DevicePart(Field):
    """A part of a field of the host that is evaluated on the device; it need not be positive."""

    def __init__(self, stage: Sizing):
        self._stage, self.dim = stage, stage.field.dim

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self._stage._values(points)
