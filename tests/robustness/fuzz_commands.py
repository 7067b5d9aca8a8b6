"""The work of `fuzz.py` on cases, the command, and damaged files of every kind."""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path

import numpy as np

import clvoro
from clvoro.adaptation.checkpoint import Saved
from clvoro.cli import command as cli
from clvoro.cli.cases import Case
from clvoro.cli.cases.files import write_toml
from clvoro.cli.jobs import Job
from clvoro.errors import InputError
from clvoro.io.vtu_read import load_vtu
from tests.robustness import fuzz_files as files
from tests.robustness.fuzz_cases import some_case
from tests.robustness.fuzz_judge import Wrong, adapter, demand, some_real
from tests.robustness.fuzz_work import WILD

_files: dict[str, bytes] = {}


def try_case(rng: np.random.Generator) -> str:
    """A valid or invalid case file, from the text to the written files."""
    with tempfile.TemporaryDirectory() as folder:
        wild = rng.random() < WILD
        text = write_toml(some_case(rng, Path(folder), some_real(rng), wild))
        case = Case.from_toml(text, "fuzz.toml", Path(folder))
        out = Path(folder) / "out"
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            Job(case, out, report=False, quiet=True).run()
        real = case.run.get("dtype", "float64")
        for name, reader in (("mesh.npz", clvoro.load), ("mesh.vtu", load_vtu)):
            demand(reader(out / name), real)
        again = Case.from_toml((out / "case.toml").read_text(), "case.toml", out)
        if (again.domain, again.table.get("layers")) != (case.domain, case.table.get("layers")):
            raise Wrong("the case that was written is another")
    return "mesh"


def try_command(rng: np.random.Generator) -> str:
    """The command with a case and options: it ends with a code that it knows, and what it writes passes `check`."""
    with tempfile.TemporaryDirectory() as name:
        folder, real = Path(name), some_real(rng)
        wild = rng.random() < WILD
        case = some_case(rng, folder, real, wild and bool(rng.integers(2)))
        (folder / "c.toml").write_text(write_toml(case))
        settings = case.get("run")
        several = isinstance(settings, dict) and "methods" in settings
        run = ["run", str(folder / "c.toml"), "--out", str(folder / "out")]
        options = [
            ["--profile"],
            ["--quiet"],
            ["--json"],
            ["--steps", "3"],
            ["--tol", "0.6"],
            ["--seed", "8"],
            ["--dtype", "float32"],
            ["--levels", "two" if wild else str(rng.choice(["auto", "0", "1"]))],
            ["--cells", "90"],
            ["--method", "magic" if wild else str(rng.choice(["exact", "lloyd"]))],
            ["--k", "0.4"],
            ["--checkpoint-every", "-1" if wild else "0"],
        ]
        if not wild and (case.get("layers") or several):  # of many rows, and without a state
            options = [o for o in options if o[0] not in ("--cells", "--checkpoint-every")]
        run += [word for option in options if rng.random() < 0.15 for word in option]
        run += [
            ["--no-report"],
            ["--no-report"],
            ["--no-report"],
            ["--picture-format", "svg", "--picture-format", "png"],
        ][rng.integers(4)]
        state = folder / "state"
        resumable = rng.random() < 0.4 and not several
        code = command(*run, *(["--checkpoint", str(state)] if resumable else []))
        if code:
            return "error"
        mesh = folder / "out" / str(rng.choice(["mesh.npz", "mesh.vtu"]))
        if not mesh.exists() or command("check", str(mesh)):
            raise Wrong(f"{' '.join(run[3:])}: no right {mesh.name}")
        if state.exists() and command(*run, "--checkpoint", str(state), "--resume", str(state)):
            raise Wrong(f"{' '.join(run[3:])}: not resumed from its own state")
        made = clvoro.load(folder / "out" / "mesh.npz")
        use(rng, made, folder)
    return "mesh"


def command(*words: str) -> int:
    """Return the exit code of the command."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
        try:
            code = cli.main(words)
        except SystemExit as end:  # an unknown word
            code = int(end.code or 0)
    if code not in (cli.OK, cli.FAILED, cli.BAD_INPUT):
        raise Wrong(f"{' '.join(words)} ends with {code}: {shown.getvalue()[-300:]}")
    return code


def use(rng: np.random.Generator, result: clvoro.Result, folder: Path) -> None:
    """What can be done with a mesh besides reading it."""
    diagram, patches = result.diagram, None
    if isinstance(diagram.domain, clvoro.Polygon) and rng.random() < 0.5:
        patches = {"inlet": [0], "wall": [1, 2]}
    with contextlib.suppress(InputError):  # which cannot hold cells around holes
        result.to_openfoam(folder / "case" / "a.foam", patches=patches)
    if diagram.domain.dim == 2 and not any(diagram.domain.periodic):
        corners = diagram.triangles()
        if corners.shape[1] != 3 or corners.max(initial=0) >= len(result.points):
            raise Wrong(f"triangles {corners.shape} of {len(result.points)} generators")
    if rng.random() < 0.2:
        import matplotlib.pyplot as plt

        result.plot(str(rng.choice(["error", "size", "quality"])))
        plt.close("all")


def try_file(rng: np.random.Generator) -> str:
    """A file with changed bits, or lost, doubled or exchanged bytes, is refused, or the damage has no effect."""
    if not _files:
        _files.update(files.valid_files(adapter("float64")))
    name = str(rng.choice(list(_files)))
    with tempfile.TemporaryDirectory() as folder:
        path, right = Path(folder) / name, Path(folder) / "right"
        path.write_bytes(files.damaged(rng, _files[name]))
        found = files.read(path)
        if isinstance(found, Saved):
            right.write_bytes(_files[name])
            if not files.same(found, Saved(right)):
                raise Wrong("a damaged checkpoint was taken")
    return f"{path.suffix or 'checkpoint'} read"
