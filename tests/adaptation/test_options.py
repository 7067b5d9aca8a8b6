"""Options of a run: which method uses which, and the warnings for the others."""

import inspect
import warnings
from dataclasses import fields

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.options import (
    METHODS,
    Checkpoint,
    MultilevelOptions,
    Options,
    PaperOptions,
    arguments_of_run,
    uses,
    warn_of_unused,
)
from clvoro.cli import command as cli
from clvoro.cli.cases import Case, builtin_cases, load_case
from clvoro.errors import InputError, InputTypeError, MemoryLimitError, UnusedOptionWarning

BOX = clvoro.Box((0, 0), (1, 1))
SIZE = clvoro.sizing.Expression("0.16 + 0.1 * x")
CHANGED_LEVELS = {"effort": "best", "levels": 1, "error_target": 0.02}
CHANGED_STEPS = {"tol": 0.9, "alpha": 0.1, "k": 0.1}
CHANGED = CHANGED_LEVELS | CHANGED_STEPS
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


def test_defaults_are_those_of_a_run():
    defaults = {
        parameter.name: parameter.default
        for signed in (clvoro.Adapter.run, MultilevelOptions, PaperOptions)
        for parameter in inspect.signature(signed).parameters.values()
    }
    defaults["start"] = defaults["points"]
    for option in fields(Options):
        assert defaults[option.name] == option.default, option.name


def test_adapt_has_the_defaults_of_a_run():
    of_run = inspect.signature(clvoro.Adapter.run).parameters
    for name, parameter in inspect.signature(clvoro.adapt).parameters.items():
        assert parameter.default == of_run[name].default, name
        assert parameter.annotation == of_run[name].annotation, name


@pytest.mark.sparse(2)
@pytest.mark.parametrize("method", METHODS)
def test_options_are_used_or_warned_of(adapter, method):
    """An option changes the result, its history, or causes a warning."""

    def made(**options):
        # Runs to the end, as some options are for the last steps; the tolerance counts from step 20 on.
        few = {"effort": "fast", "max_steps": 70} if uses(method, "effort") else {"max_steps": 30}
        run = adapter.run(BOX, SIZE, method=method, seed=4, **arguments_of_run({**few, **options}))
        history = [run.history[name] for name in run.history.dtype.names if name != "seconds"]
        return run, [np.asarray(a).tobytes() for a in (run.points, run.size_error, *history)]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, plain = made()
    # Options that the method does not use in one run for each of the two classes.
    together = [
        {name: value for name, value in part.items() if not uses(method, name)}
        for part in (CHANGED_LEVELS, CHANGED_STEPS)
    ]
    alone = [{name: value} for name, value in CHANGED.items() if uses(method, name)]
    for given in filter(None, [*together, *alone]):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run, found = made(**given)
        assert (found != plain) == (given in alone), given
        assert set(given).isdisjoint(run.settings) == (given in together)
        warned = [w for w in caught if w.category is UnusedOptionWarning]
        assert len(warned) == (len(given) if given in together else 0), given
        for name, value in given.items() if warned else ():
            said = f"{name} is {value!r}, which the method {method} does not use"
            assert any(said in str(w.message) for w in warned), name
        assert {w.filename for w in warned} <= {__file__}


def test_values_without_effect_cause_no_warning(adapter):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        adapter.run(BOX, 0.4, effort="fast", options=PaperOptions(tol=0))
        adapter.run(BOX, 0.4, method="lloyd", max_steps=0, options=MultilevelOptions(levels=0))
        adapter.memory_needed(BOX, 0.1, method="lloyd")
    with pytest.warns(UnusedOptionWarning, match="it is for adaptive, exact, transport; leave it out"):
        adapter.memory_needed(BOX, 0.1, method="lloyd", options=MultilevelOptions(levels=2))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: PaperOptions(tol=-0.1), InputError, "tol is -0.1"),
        (lambda: PaperOptions(tol=np.nan), InputError, "tol is nan"),
        (lambda: PaperOptions(k=-1), InputError, "k is -1, expected a finite number > 0"),
        (lambda: PaperOptions(k=0), InputError, "k is 0"),
        (lambda: PaperOptions(k="big"), InputTypeError, "k is 'big'"),
        (lambda: PaperOptions(alpha=0), InputError, "alpha is 0"),
        (lambda: PaperOptions(alpha=np.inf), InputError, "alpha is inf"),
        (lambda: MultilevelOptions(levels=-1), InputError, "levels is -1"),
        (lambda: MultilevelOptions(levels="many"), InputTypeError, "levels is 'many'"),
        (lambda: MultilevelOptions(error_target=0), InputError, "error_target is 0"),
        (lambda: PaperOptions(tol="1e-3"), InputTypeError, "tol is '1e-3' of type str"),
        (lambda: Checkpoint("file", every=-1), InputError, "every is -1"),
        (lambda: Checkpoint(resume=True), InputError, r"expected Checkpoint\(path, resume=True\)"),
    ],
)
def test_bad_options(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_options_of_a_kind(adapter):
    with pytest.raises(InputTypeError, match=r"options is .*expected clvoro.MultilevelOptions"):
        adapter.run(BOX, 0.3, options={"tol": 0})
    with pytest.warns(UnusedOptionWarning, match="no checkpoint is written") as caught:
        Checkpoint(every=5)
    assert caught[0].filename == __file__


def test_levels(adapter, tmp_path, capsys):
    with pytest.raises(InputTypeError, match="levels is '2' of type str, expected an integer or 'auto'"):
        MultilevelOptions(levels="2")
    with pytest.raises(InputError, match="levels is -1, expected at least 0"):
        MultilevelOptions(levels=-1)
    with pytest.raises(InputTypeError, match="correct is 'no' of type str, expected True or False"):
        MultilevelOptions(correct="no")
    with pytest.raises(InputError, match=r"levels is 50, expected at most \d for 10000 cells"):
        adapter.run(BOX, 0.01, options=MultilevelOptions(levels=50))
    # Sizes may require more cells than 64 bits can count.
    with pytest.raises(MemoryLimitError, match=r"the run has 1e\+22 cells"):
        adapter.run(BOX, 1e-11, options=MultilevelOptions(levels=50))
    (tmp_path / "c.toml").write_text(CASE)
    for text in ("two", "-1"):
        assert cli.main(["run", str(tmp_path / "c.toml"), f"--levels={text}"]) == cli.BAD_INPUT
        assert "expected one of auto, a whole number" in capsys.readouterr().err


def run(folder, text, *options):
    (folder / "c.toml").write_text(text)
    run = ["run", str(folder / "c.toml"), "--out", str(folder / "out"), "--no-report", "--quiet"]
    return cli.main([*run, *options])


@pytest.mark.sparse(3)
@pytest.mark.parametrize(
    ("run_table", "options", "warned"),
    [
        ('method = "lloyd"\neffort = "fast"\nlevels = 1', [], ["effort", "levels"]),
        ("k = 0.7\nalpha = 1", [], ["alpha", "k"]),
        ('methods = ["lloyd", "weighted"]\nerror_target = 0.1', [], ["error_target"]),
        ("", ["--method", "lloyd", "--effort", "fast", "--levels", "3"], ["effort", "levels"]),
        # One of the methods uses each.
        ('methods = ["lloyd", "adaptive"]\neffort = "fast"\nk = 0.7', [], []),
        # They were for another method.
        ('effort = "fast"\nerror_target = 0.1', ["--method", "lloyd", "--k", "0.7"], []),
        ('methods = ["lloyd", "coupled"]\nk = 0.7\ntol = 0.1', ["--method", "adaptive"], []),
    ],
)
def test_cases(tmp_path, capsys, run_table, options, warned):
    assert run(tmp_path, CASE + run_table, *options) == cli.OK
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(warned), lines
    for name, line in zip(warned, lines, strict=True):
        assert line.startswith(f"clvoro: warning: {name} is ")
    # Only used options are written.
    written = Case.from_toml((tmp_path / "out" / "case.toml").read_text(), "written")
    assert not set(warned) & set(written.run)
    demand_use(written)


def demand_use(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_unused(case.run, [method or Options.method for method in case.methods])


@pytest.mark.sparse(3)
@pytest.mark.parametrize("name", builtin_cases())
def test_built_in_cases_have_no_unused_options(name):
    case = load_case(name)
    for chosen in (case, *(case.with_run(method=method) for method in METHODS)):
        demand_use(chosen)
