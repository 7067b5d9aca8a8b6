"""Public names have docstrings, and the examples in them are right."""

import doctest
import inspect
import re

import numpy as np
import pytest

import clvoro
from clvoro.geometry.domain import FOR_CALLERS

PUBLIC = [getattr(clvoro, name) for name in clvoro.__all__] + [
    getattr(clvoro.sizing, name) for name in clvoro.sizing.__all__
]


def test_the_package_itself():
    found = doctest.testmod(clvoro)
    assert found.attempted > 5
    assert found.failed == 0
    for name in clvoro.__all__:
        if inspect.isclass(getattr(clvoro, name)) and name not in ("ClvoroError", "Displacements"):
            assert f"`{name}`" in clvoro.__doc__ or f"`{name}." in clvoro.__doc__, name


def members(thing):
    """The public functions that a class of clvoro defines itself or inherits from another of clvoro."""
    if not inspect.isclass(thing):
        return []
    found = inspect.getmembers(thing, lambda m: inspect.isfunction(m) or isinstance(m, property))
    return [m for name, m in found if not name.startswith("_")]


@pytest.mark.parametrize("thing", PUBLIC, ids=lambda t: getattr(t, "__name__", str(t)))
def test_public_names_say_what_they_are(thing):
    assert (thing.__doc__ or "").strip()
    # A dataclass without a docstring of its own is given its signature.
    assert not thing.__doc__.startswith(f"{thing.__name__}(")
    for member in members(thing):
        assert (inspect.getdoc(member) or "").strip(), member


@pytest.mark.parametrize("thing", PUBLIC, ids=lambda t: getattr(t, "__name__", str(t)))
def test_parameters_are_all_described(thing):
    """A docstring that lists parameters lists those that there are, and no others."""
    for what in [thing, *members(thing)]:
        text = inspect.getdoc(what) or ""
        if "Parameters\n----------" not in text or isinstance(what, property):
            continue
        part = re.split(r"\n[A-Z]\w+\n---", text.split("Parameters\n----------\n")[1])[0]
        listed = set()
        for line in part.split("\n"):
            if line and not line.startswith(" "):
                listed |= {n.strip().lstrip("*") for n in line.split(" : ")[0].split(",")}
        there = set(inspect.signature(what).parameters) - {"self", "cls"}
        assert listed == there, what
        domain = re.search(r"^domain : (.*)", part, re.MULTILINE)
        assert not domain or re.search("Box|Polygon", domain[1]), f"{what} does not say which domains it takes"


def test_domains_list_what_is_for_callers():
    for domain in (clvoro.Box((0, 0), (1, 1)), clvoro.Sphere(), clvoro.Polygon([(0, 0), (1, 0), (0, 1)])):
        listed = {name for name in dir(domain) if not name.startswith("_")}
        assert FOR_CALLERS <= listed
        assert len(listed) < 50
        assert hasattr(domain, "stations")
        assert "stations" not in listed


TESTED = set()
"""Whose examples have been run: classes inherit some of their methods from one another."""


@pytest.mark.parametrize("thing", PUBLIC, ids=lambda t: getattr(t, "__name__", str(t)))
def test_examples_are_right(thing, ctx, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"clvoro": clvoro, "np": np, "sizing": clvoro.sizing}
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    things = [thing] if inspect.ismodule(thing) else [thing, *members(thing)]
    for what in things:
        if what in TESTED:
            continue
        TESTED.add(what)
        for test in finder.find(what, getattr(what, "__name__", "property"), globs=names):
            runner.run(test)
    assert runner.failures == 0
