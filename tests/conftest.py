"""What all tests share: repeatable examples, no windows, a context on the default device."""

import base64
import binascii
import os

import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# Examples are the same in every run, and the first build of a kernel may take its time.
settings.register_profile("clvoro", derandomize=True, deadline=None, database=None)
settings.load_profile("clvoro")


@pytest.fixture(scope="session")
def ctx():
    from clvoro.device import create_context

    return create_context()


@pytest.fixture
def meshio_for_vtu():
    """The module, if it can read VTU: it wants base64 that stops at padding, as Python's did before 3.13."""
    meshio = pytest.importorskip("meshio")
    try:
        stops = base64.b64decode("QQ==QUI=") == b"A"
    except binascii.Error:
        stops = False
    return meshio if stops else pytest.skip("meshio does not read VTU by this Python's base64")


if "CLVORO_TEST_GROUPS" in os.environ:
    from gpu_like import use_groups

    use_groups(int(os.environ["CLVORO_TEST_GROUPS"]))
