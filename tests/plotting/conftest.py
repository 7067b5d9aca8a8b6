import pytest


@pytest.fixture(autouse=True)
def nothing_stays_open():
    from matplotlib import pyplot

    yield
    pyplot.close("all")
