"""An engine without stages."""

import numpy as np
import pyopencl as cl
import pytest

from clvoro.opencl.engine import Engine


@pytest.fixture
def engine(ctx):
    return Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))
