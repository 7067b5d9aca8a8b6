"""What all tests share: repeatable examples, no windows, a context on the default device."""

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


if "CLVORO_TEST_GROUPS" in os.environ:
    from gpu_like import use_groups

    use_groups(int(os.environ["CLVORO_TEST_GROUPS"]))
