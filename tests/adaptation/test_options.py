"""Options of a run: which of them which method uses, and what is told of those that it does not."""

import inspect
import warnings
from dataclasses import fields

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.options import METHODS, Options, uses, warn_of_unused
from clvoro.cli import command as cli
from clvoro.cli.cases import Case, builtin_cases, load_case
from clvoro.errors import InputError, InputTypeError, UnusedOptionWarning

BOX = clvoro.Box((0, 0), (1, 1))
SIZE = clvoro.sizing.Expression("0.16 + 0.1 * x")
CHANGED = {
    "effort": "best",
    "levels": 1,
    "error_target": 0.02,
    "tol": 0.9,
    "alpha": 0.1,
    "k": 0.1,
}
CASE = """
[domain]
lower = [0, 0]
upper = [1, 1]
[size]
kind = "constant"
value = 0.3
[run]
max_steps = 1
"""


@pytest.fixture(scope="module")
def adapter(ctx):
    return clvoro.Adapter(ctx)


def test_defaults_are_those_of_a_run():
    parameters = inspect.signature(clvoro.Adapter.run).parameters
    for option in fields(Options):
        assert parameters[option.name].default == option.default, option.name


@pytest.mark.parametrize("method", METHODS)
def test_options_are_used_or_warned_of(adapter, method):
    """What is told is so: an option changes the result, its history or neither."""

    def made(**options):
        # From start to end: some options are for the last steps, and a tolerance is looked at after twenty.
        few = (
            {"effort": "fast", "max_steps": 70}
            if uses(method, "effort")
            else {"max_steps": 30, "tol": 1e-9}
        )
        run = adapter.run(BOX, SIZE, method=method, seed=4, **{**few, **options})
        history = [run.history[name] for name in run.history.dtype.names if name != "seconds"]
        return run, [np.asarray(a).tobytes() for a in (run.points, run.error, *history)]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, plain = made()
    for name, value in CHANGED.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run, found = made(**{name: value})
        assert (found != plain) == uses(method, name), name
        assert (name in run.settings) == uses(method, name)
        told = [w for w in caught if w.category is UnusedOptionWarning]
        assert len(told) == (not uses(method, name)), name
        for w in told:
            assert f"{name} is {value!r}, which the method {method} does not use" in str(w.message)
            assert w.filename == __file__


def test_what_is_done_anyway_is_not_warned_of(adapter):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        adapter.run(BOX, 0.4, effort="fast", tol=0)
        adapter.run(BOX, 0.4, method="lloyd", max_steps=0, levels=0, effort="default")
        adapter.memory_needed(BOX, 0.1, method="lloyd")
    with pytest.warns(UnusedOptionWarning, match="it is for adaptive, exact; leave it out"):
        adapter.memory_needed(BOX, 0.1, method="lloyd", levels=2)


def test_levels(adapter, tmp_path, capsys):
    with pytest.raises(InputTypeError, match="levels is '2' of type str, expected an integer or 'auto'"):  # fmt: skip
        adapter.run(BOX, 0.1, levels="2")
    with pytest.raises(InputError, match="levels is -1, expected at least 0"):
        adapter.run(BOX, 0.1, levels=-1)
    # Sizes may ask for more cells than 64 bits can count.
    with pytest.raises(InputError, match=r"levels is 50, expected at most 36 for \d{22} cells"):
        adapter.run(BOX, 1e-11, levels=50)
    (tmp_path / "c.toml").write_text(CASE)
    for text in ("two", "-1"):
        assert cli.main(["run", str(tmp_path / "c.toml"), f"--levels={text}"]) == cli.BAD_INPUT
        assert "expected a whole number, 0 or more, or 'auto'" in capsys.readouterr().err


def run(folder, text, *options):
    (folder / "c.toml").write_text(text)
    run = ["run", str(folder / "c.toml"), "--out", str(folder / "out"), "--no-report", "--quiet"]
    return cli.main([*run, *options])


@pytest.mark.parametrize(
    ("run_table", "options", "told"),
    [
        ('method = "lloyd"\neffort = "fast"\nlevels = 1', [], ["effort", "levels"]),
        ("k = 0.7\nalpha = 1", [], ["k", "alpha"]),
        ('methods = ["lloyd", "weighted"]\nerror_target = 0.1', [], ["error_target"]),
        ("", ["--method", "lloyd", "--effort", "fast", "--levels", "3"], ["effort", "levels"]),
        # One of the methods uses each.
        ('methods = ["lloyd", "adaptive"]\neffort = "fast"\nk = 0.7', [], []),
        # They were for another method.
        ('effort = "fast"\nerror_target = 0.1', ["--method", "lloyd", "--k", "0.7"], []),
        ('methods = ["lloyd", "coupled"]\nk = 0.7\ntol = 0.1', ["--method", "adaptive"], []),
    ],
)  # fmt: skip
def test_cases(tmp_path, capsys, run_table, options, told):
    assert run(tmp_path, CASE + run_table, *options) == cli.OK
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(told), lines
    for name, line in zip(told, lines, strict=True):
        assert line.startswith(f"clvoro: warning: {name} is ")
    # What is written has only what is of use.
    written = Case.from_toml((tmp_path / "out" / "case.toml").read_text(), "written")
    assert not set(told) & set(written.run)
    demand_use(written)


def demand_use(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_unused(case.run, [method or Options.method for method in case.methods], 1)


@pytest.mark.parametrize("name", builtin_cases())
def test_built_in_cases_give_what_is_used(name):
    case = load_case(name)
    for chosen in (case, *(case.with_run(method=method) for method in METHODS)):
        demand_use(chosen)
