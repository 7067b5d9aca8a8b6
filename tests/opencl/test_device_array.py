"""Device arrays behave as PyOpenCL's and NumPy's."""

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

from clvoro.opencl import device_array as _device_array
from clvoro.opencl.device_array import make_array, read_number


@pytest.fixture
def queue(ctx):
    return cl.CommandQueue(ctx)


@pytest.fixture(params=[True, False])
def quick(request, monkeypatch):
    """Also without PyOpenCL's private option to skip checks."""
    monkeypatch.setattr(_device_array, "_QUICK", request.param and _device_array._QUICK)


SHAPES = [7, (7,), (7, 2), (3, 4, 5), (), (0,), (0, 2), (1,)]


@pytest.mark.sparse(6)
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("shape", SHAPES)
def test_arrays_agree_with_pyopencl(queue, shape):
    dtype = np.dtype(np.int32)
    mine, plain = make_array(queue, shape, dtype), cla.Array(queue, shape, dtype)
    for name in ("shape", "dtype", "strides", "size", "nbytes", "offset", "queue", "context", "ndim"):
        assert getattr(mine, name) == getattr(plain, name), name
    assert (mine.base_data is None) == (plain.base_data is None)
    assert mine.flags.c_contiguous == plain.flags.c_contiguous
    host = np.arange(mine.size, dtype=dtype).reshape(mine.shape)
    mine.set(host)
    assert np.array_equal(mine.get(), host)
    assert np.array_equal((mine + mine).get(), host + host)
    assert np.array_equal(mine.copy().get(), host)


INDICES = [
    slice(None),
    slice(None, 0),
    slice(None, 3),
    slice(None, 9),
    slice(2, 5),
    slice(None, -2),
    slice(None, 6, 2),
    0,
    6,
    -1,
    np.int64(4),
]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("shape", [(7,), (7, 2)])
@pytest.mark.parametrize("index", INDICES, ids=str)
def test_views_agree_with_numpy(queue, shape, index):
    host = np.arange(np.prod(shape), dtype=np.int64).reshape(shape)
    array = make_array(queue, shape, host.dtype)
    array.set(host)
    view = array[index]
    assert view.shape == host[index].shape
    if view.flags.forc:  # PyOpenCL fetches contiguous arrays only
        assert np.array_equal(view.get(), host[index])
    # Of a view that begins within the array, too.
    tail, host_tail = array[2:], host[2:]
    if not isinstance(index, int) or index < 5:
        view = tail[index]
        assert view.shape == host_tail[index].shape
        if view.flags.forc:
            assert np.array_equal(view.get(), host_tail[index])


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("index", [7, -8])
def test_index_out_of_range_raises(queue, index):
    with pytest.raises(IndexError):
        make_array(queue, 7, np.dtype(np.int32))[index]


@pytest.mark.usefixtures("quick")
def test_too_many_indices_raise(queue):
    with pytest.raises((IndexError, TypeError)):
        make_array(queue, (), np.dtype(np.int32))[0]


@pytest.mark.sparse(20)
@pytest.mark.parametrize("dtype", [np.int32, np.uint64, np.float32, np.float64, np.uint8])
@pytest.mark.parametrize("size", [1, 2, 3, 16, 33, 1000, 1024])
@pytest.mark.parametrize("value", [0, 5])
def test_fill_sets_exactly_the_array(queue, dtype, size, value):
    """A whole array, its first items, and items from an odd offset on have different largest patterns."""
    array = make_array(queue, size + 40, np.dtype(dtype))
    for begin in (0, 1, 8):
        host = np.arange(size + 40).astype(dtype)
        array.set(host)
        view = array[:size] if begin == 0 else array[begin : begin + size]
        assert view.fill(value) is view
        host[begin : begin + size] = value
        assert np.array_equal(array.get(), host)


@pytest.mark.usefixtures("quick")
def test_writing_another_shape_raises(queue):
    array = make_array(queue, 4, np.dtype(np.int32))
    for wrong in (np.zeros(3, np.int32), np.zeros(4, np.float32), np.zeros((4, 1), np.int32)):
        with pytest.raises((RuntimeError, AssertionError)):
            array.set(wrong)
    strided = np.arange(8, dtype=np.int32)[::2]
    with pytest.raises(RuntimeError):
        array.set(strided)


@pytest.mark.usefixtures("quick")
def test_read_number_agrees_with_a_view(queue):
    host = np.array([3, -1, 2**31 - 1, 7], np.int32)
    array = make_array(queue, 4, host.dtype)
    array.set(host)
    assert [read_number(array, k) for k in range(4)] == host.tolist()
    assert [read_number(array[1:], k) for k in range(3)] == host[1:].tolist()
    for outside in (-1, 4):
        with pytest.raises(IndexError):
            read_number(array, outside)


def test_marks_distinguish_arrays(queue):
    array = make_array(queue, 8, np.dtype(np.int32))
    assert array[:3].mark == array.mark == array[:0].mark or array[:0].base_data is None
    others = [array[2:], array[2], make_array(queue, 8, array.dtype), array.copy(), array + array]
    assert len({array.mark, *(other.mark for other in others)}) == 1 + len(others)
