"""Adapters of both precisions."""

import pytest

import clvoro


@pytest.fixture(scope="module")
def adapter():
    return clvoro.Adapter()


@pytest.fixture(scope="module")
def adapter32():
    return clvoro.Adapter(dtype="float32")
