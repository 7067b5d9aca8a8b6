"""Engines of both precisions."""

import numpy as np
import pyopencl as cl
import pytest

from clvoro.opencl.engine import Engine


@pytest.fixture(scope="module")
def queue(ctx):
    return cl.CommandQueue(ctx)


@pytest.fixture(params=["float64", "float32"])
def make_engine(request, queue):
    return lambda dim: Engine(queue.context, queue, dim, np.dtype(request.param))
