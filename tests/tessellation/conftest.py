"""Adapters of both precisions."""

import pytest

import clvoro


@pytest.fixture(scope="module", params=["float64", "float32"])
def adapter(ctx, request):
    return clvoro.Adapter(ctx, request.param)


@pytest.fixture(scope="module")
def adapter64(ctx):
    return clvoro.Adapter(ctx)
