"""Meshes in float32 on devices that round quotients and square roots by up to 2.5 and 3 ulp."""

import numpy as np
import pytest

import clvoro
from clvoro.opencl import program
from tests.robustness.rough_division import rough_quotients, use_rough_division

BOX = clvoro.Box((0, 0), (2.5, 1.5))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("domain", [BOX, CUBE], ids=["2D", "3D"])
def test_rough_quotients_change_nothing_but_rounding(ctx, domain, monkeypatch):
    """Float32 quotients and roots that are off by units in the last place, as OpenCL allows."""
    size = clvoro.sizing.Expression(f"{0.06 if domain.dim == 2 else 0.2} * (1 + x / 2)")

    def run():
        adapter = clvoro.Adapter(ctx, "float32")
        return adapter.run(domain, size, seed=5, effort="fast")

    plain = run()
    monkeypatch.setattr(program, "source_text", program.source_text)
    monkeypatch.setattr(program, "has_short_declarations", lambda _: False)
    use_rough_division()
    rough = run()
    assert rough.diagram.check()
    assert not np.array_equal(plain.points, rough.points)
    assert abs(len(plain.points) - len(rough.points)) <= 0.02 * len(plain.points) + 1
    for name in ("size_error", "quality"):
        mine, other = (np.abs(getattr(r, name)).mean() for r in (plain, rough))
        assert mine == pytest.approx(other, rel=0.1)


def test_quotients_are_found_inprograms():
    """In products, nested quotients, conditions and macros; constants and powers of two stay exact."""
    cases = {
        "x = a * b / c[3].s0 * d / (REAL)(e + f);": "x = rough(rough(a * b / c[3].s0, 2) * d / (REAL)(e + f), 2);",
        "y = -p->q / sqrt(v / w);": "y = -rough(p->q / rough_sqrt(rough(v / w, 2)), 2);",
        "if (n > 0) a[i].x /= s.t;": "if (n > 0) a[i].x = rough(a[i].x  / ( s.t), 2);",
        "g = on ? a / b : c / -d;": "g = on ? rough(a / b, 2) : rough(c / -d, 2);",
        "h = u / 2 + SLOT / WIDTH;": "h = u / 2 + SLOT / WIDTH;",
        "#define RATIO(a, b) ((a) / (b))": "#define RATIO(a, b) (rough((a) / (b), 2))",
    }
    for code, expected in cases.items():
        assert rough_quotients(code).splitlines()[-1] == expected
