"""The command `clvoro`: run a case, convert and check meshes, list devices and built-in cases.

Each command imports what it needs when it starts, so that `clvoro --help` answers at once.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import Aborted, BuildError, ClvoroError, DeviceError, InputError, InputTypeError, OutputError
from ..geometry.boundary_layers import Layers
from ..opencl.peers import ALONE
from ..version import __version__
from .outputs import MESH_FILES, NAMES
from .progress import steady_streams
from .ranks import end_together, may_speak, this_rank

OK, FAILED, BAD_INPUT, NO_DEVICE, INTERRUPTED = 0, 1, 2, 3, 130

_EPILOG = """\
exit codes:
  0    done
  1    the run failed or misses its sizes (mean |e| above 0.2), or a file could
       not be written; check: a mesh is wrong; run --check-solver: the solver
       rejects the mesh
  2    bad usage or input, or the output folder cannot be made;
       check: a file cannot be read
  3    no usable device
  130  interrupted (Ctrl-C, SIGTERM, SIGHUP, SIGXCPU; the mesh so far and, if
       steps are left, a checkpoint have been written)

examples:
  clvoro run paper                      the paper's validation case, into out/paper
  clvoro run airfoil --device gpu       a wing section on a GPU
  clvoro cases paper > my.toml          a case file to start from
  clvoro run my.toml --effort fast --out result --format openfoam
  clvoro run my.toml --checkpoint my.state                   and, after a crash,
  clvoro run my.toml --checkpoint my.state --resume my.state
  mpiexec -n 4 clvoro run my.toml       over 4 ranks of MPI, a device for each
  clvoro convert result/mesh.npz mesh.nc
  clvoro check result/mesh.vtu          verify the mesh
  clvoro check --for openfoam result/mesh.vtu
  clvoro run ocean --format mpas        a mesh of the Earth for ocean models
  clvoro check --for mpas out/ocean/mesh.vtu
  clvoro foam adapt CASE --cells 6000 --cycles 3 --solver simpleFoam
"""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="clvoro",
        description="Adapt Voronoi meshes to a size field, with OpenCL on any CPU or GPU.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"clvoro {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_convert(commands)
    _add_check(commands)
    _add_foam(commands)
    devices = commands.add_parser("devices", help="list the OpenCL devices and whether they work")
    devices.set_defaults(work=_devices)
    cases = commands.add_parser("cases", help="list the built-in cases, or print one")
    cases.add_argument("case", metavar="NAME", nargs="?", help="print the TOML text of this case")
    cases.set_defaults(work=_cases)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser(
        "run",
        help="run a case: mesh, history and report",
        description="Run a case and write mesh.vtu, mesh.npz, history.csv, case.toml, report.html and\n"
        "pictures/. Options override the case.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.set_defaults(work=_run)
    run.add_argument("case", metavar="CASE", help="a TOML file, or the name of a built-in case")
    _add_settings(run.add_argument_group("settings of the run"))
    _add_checkpoints(run.add_argument_group("checkpoints"))
    _add_output(run.add_argument_group("output"))


def _add_settings(run: Any) -> None:
    run.add_argument(
        "--device",
        metavar="NAME",
        help="gpu, cpu, part of a name, or PLATFORM:DEVICE indices; several devices, such as 0:0,0:1, share the run",
    )
    run.add_argument("--share-gpus", action="store_true", help="let several ranks, or parts of a run, use one device")
    run.add_argument(
        "--method",
        metavar="M",
        help="adaptive (the default), exact, transport, or one kind of step: coupled (the paper's), lloyd, "
        "poisson, weighted-lloyd, weighted, mmpde, monge-ampere; or several: lloyd,coupled",
    )
    run.add_argument(
        "--effort", choices=("fast", "default", "best"), help="work against quality (adaptive, exact, transport)"
    )
    run.add_argument(
        "--levels",
        metavar="N",
        help="number of coarser levels to start from, or auto (the default; adaptive, exact, transport)",
    )
    run.add_argument("--start", choices=("density", "uniform"), help="random start: by h^-d, or uniform")
    run.add_argument("--cells", metavar="N", type=int, dest="n_cells", help="number of cells (default: from h)")
    run.add_argument("--steps", metavar="N", type=int, dest="max_steps", help="largest number of steps")
    repeated = "(methods of one kind of step)"
    run.add_argument("--tol", type=float, metavar="T", help=f"stop when gains fall below this share {repeated}")
    run.add_argument("--k", type=float, metavar="K", help=f"largest displacement over h in a step {repeated}")
    run.add_argument("--seed", type=int, metavar="S", help="seed of the random start")
    run.add_argument("--dtype", choices=("float64", "float32"), help="precision on the device")


def _add_checkpoints(run: Any) -> None:
    run.add_argument(
        "--checkpoint",
        metavar="FILE",
        type=_path,
        help="write the state of the run there (default: OUT/run.checkpoint, only if it is stopped)",
    )
    run.add_argument("--checkpoint-every", metavar="SECONDS", type=float, help="time between checkpoints (default: 60)")
    run.add_argument("--resume", metavar="FILE", type=_path, help="continue from a checkpoint of the same case")


def _add_output(run: Any) -> None:
    run.add_argument("--out", metavar="DIR", type=_path, help="output folder (default: out/NAME of the case)")
    run.add_argument(
        "--format",
        metavar="LIST",
        dest="mesh_formats",
        type=_mesh_formats,
        default=(),
        help=f"further mesh files, such as openfoam,nc: {', '.join(MESH_FILES)}",
    )
    _add_processors(run, more="; for METIS: also write graph.info.part.N")
    run.add_argument(
        "--pieces",
        action="store_true",
        help="under mpiexec: each rank writes its own cells, as mesh.pvtu in place of mesh.vtu, mesh.npz and the "
        "report; only --format openfoam gathers the whole mesh on rank 0",
    )
    _add_types(run)
    _add_walls(run)
    _add_unchecked(run)
    run.add_argument(
        "--check-solver",
        dest="solver",
        choices=("openfoam",),
        help="check the mesh by the criteria of a solver, with its own program if that is installed",
    )
    run.add_argument("--no-report", dest="report", action="store_false", help="no pictures and no page")
    run.add_argument(
        "--picture-format",
        dest="picture_formats",
        metavar="KIND",
        action="append",
        choices=("png", "pdf", "svg"),
        help="kind of picture files, may be repeated (default: png)",
    )
    run.add_argument("--profile", action="store_true", help="print where the time goes, by stage and by kernel")
    run.add_argument("--quiet", "-q", action="store_true", help="print errors only")
    run.add_argument("--json", dest="as_json", action="store_true", help="print one JSON object per finished run")


def _add_types(command: Any) -> None:
    command.add_argument(
        "--types",
        metavar="LIST",
        type=_patch_types,
        default={},
        help="types of OpenFOAM's patches, such as top=symmetry,left=patch: wall, patch, symmetry or symmetryPlane "
        "(default: patch for names like inlet, outlet and open, else wall)",
    )


def _add_walls(command: Any, more: str = "") -> None:
    command.add_argument(
        "--walls",
        choices=("straight", "exact"),
        help=f"boundary of a mesh for OpenFOAM: straight faces (the default), or as in the domain{more}",
    )


def _add_processors(command: Any, more: str = "") -> None:
    command.add_argument(
        "--processors", metavar="N", type=int, help=f"for OpenFOAM: also write a case decomposed for N processors{more}"
    )


def _add_unchecked(command: Any) -> None:
    command.add_argument(
        "--unchecked", action="store_true", help="write a mesh for OpenFOAM even if its checkMesh rejects it"
    )


def _add_convert(commands: Any) -> None:
    convert = commands.add_parser(
        "convert",
        help="write a mesh in another format",
        description="Read a mesh that clvoro wrote and write it in the format that the suffix of OUT names: .vtu, "
        ".npz, .foam (or a folder polyMesh), .cgns, .nc, .info (METIS), .info.part.N (its parts), .vtk, .ply, .obj.",
    )
    convert.set_defaults(work=_convert)
    convert.add_argument("mesh", metavar="MESH", help="mesh.npz, mesh.vtu, mesh.pvtu, or mesh.nc on a sphere")
    convert.add_argument("out", metavar="OUT", type=_path, help="file to write")
    convert.add_argument(
        "--convention", choices=("ugrid", "mpas", "scrip"), help="content of a .nc file (default: ugrid)"
    )
    _add_types(convert)
    _add_walls(convert, more="; of a .vtu file: as in the domain is the default")
    _add_unchecked(convert)
    _add_processors(convert)


def _add_check(commands: Any) -> None:
    check = commands.add_parser(
        "check",
        help="verify meshes: volumes, graph, faces, the Voronoi property, error and quality",
        description="Verify meshes that clvoro wrote, on the host alone, and print each violation with its place. "
        "With --for openfoam: print each criterion of its checkMesh, with value, limit and worst place. "
        "With --for mpas: the same for models on C grids, on spheres and in the plane. With --for modflow: the same "
        "for MODFLOW 6's DISV grids. OpenFOAM's meshes (a file .foam, a case, a folder polyMesh) are read as they are. "
        "Exit code 0: all is right; 1: something is wrong; 2: a file cannot be read.",
    )
    check.set_defaults(work=_check)
    check.add_argument("files", metavar="FILE", nargs="+", help="mesh.npz, mesh.vtu, mesh.nc on a sphere, or mesh.foam")
    check.add_argument(
        "--for",
        dest="solver",
        choices=("openfoam", "mpas", "modflow"),
        help="check by the criteria of this solver, which need not be installed, instead",
    )
    _add_walls(check)
    check.add_argument("--json", action="store_true", help="print one JSON object per file")


def _add_foam(commands: Any) -> None:
    foam = commands.add_parser("foam", help="cases of OpenFOAM: adapt the mesh to the solution")
    adapt = foam.add_subparsers(dest="foam_command", metavar="COMMAND", required=True).add_parser(
        "adapt",
        help="adapt the mesh of a case to its latest time, once or in a loop with its solver",
        description="Estimate sizes from the latest time of a case, adapt its mesh, and transfer all fields in cells.\n"
        "The new mesh and its fields take the place of the latest time in one step. With --solver the case is\n"
        "solved before each cycle, and at the end; a call that was killed goes on if it is repeated. The report is\n"
        "CASE/clvoro/report.csv.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    adapt.set_defaults(work=_foam_adapt)
    adapt.add_argument("case", metavar="CASE", type=_path, help="the folder with system, constant and times")
    adapt.add_argument("--cells", metavar="N", type=int, required=True, help="number of cells of the new mesh")
    adapt.add_argument(
        "--fields", metavar="LIST", type=_names, default=("U",), help="fields that the mesh follows (default: U)"
    )
    adapt.add_argument(
        "--window",
        metavar="T",
        type=float,
        default=0.0,
        help="written times as far as this before the latest one count, too, such as a period (default: 0)",
    )
    goal = adapt.add_mutually_exclusive_group()
    goal.add_argument("--forces", metavar="LIST", type=_names, default=(), help="patches whose forces are the goal")
    goal.add_argument(
        "--adjoints", metavar="LIST", type=_names, default=(), help="adjoint velocities of goals, among the fields"
    )
    adapt.add_argument("--cycles", metavar="N", type=int, default=1, help="number of meshes (default: 1)")
    adapt.add_argument("--solver", metavar="PROGRAM", help="program that solves the case, such as simpleFoam")
    adapt.add_argument(
        "--interval",
        metavar="T",
        type=float,
        help="time or iterations that the solver advances in each cycle (default: those of system/controlDict)",
    )
    adapt.add_argument(
        "--layers",
        metavar="PATCHES:HEIGHT:COUNT[:GROWTH[:SPACING]]",
        type=_layers,
        action="append",
        help="boundary layers, such as cylinder:0.0008:4:1.15; may be repeated (default: those of the last call)",
    )
    adapt.add_argument(
        "--mesh", metavar="FILE", type=_path, help="the present mesh as clvoro saved it (default: from the boundary)"
    )
    adapt.add_argument(
        "--p", type=float, metavar="P", help="norm of the error that is small (default: 2; 1 for a goal)"
    )
    adapt.add_argument("--h-min", type=float, default=0.0, metavar="H", help="smallest size")
    adapt.add_argument("--h-max", type=float, default=math.inf, metavar="H", help="largest size")
    adapt.add_argument("--growth", type=float, default=1.2, metavar="G", help="ratio of neighboring sizes at most")
    adapt.add_argument("--effort", choices=("fast", "default", "best"), default="default", help="work against quality")
    adapt.add_argument("--device", metavar="NAME", help="gpu, cpu, part of a name, or PLATFORM:DEVICE indices")
    adapt.add_argument("--no-pictures", action="store_true", help="no pictures")
    adapt.add_argument("--json", action="store_true", help="print one JSON object per cycle")


def _names(text: str) -> tuple[str, ...]:
    """Return the names in `text`, separated by commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _layers(text: str) -> Layers:
    """Return the boundary layers that `text` describes: patches, height, count, growth and spacing."""
    from ..geometry.boundary_layers import Layers

    patches, *numbers = text.split(":")
    try:
        if not 2 <= len(numbers) <= 4:
            raise ValueError("it has not two to four numbers")
        given = dict(zip(("growth", "spacing"), map(float, numbers[2:]), strict=False))
        return Layers(float(numbers[0]), int(numbers[1]), **given, edges=_names(patches) or None)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not PATCHES:HEIGHT:COUNT[:GROWTH[:SPACING]], expected such as cylinder:0.0008:4:1.15; {error}"
        ) from error


def _mesh_formats(text: str) -> tuple[str, ...]:
    """Return the formats in `text`, separated by commas."""
    parts = (part.strip().lower() for part in text.split(","))
    formats = tuple(dict.fromkeys(NAMES.get(part, part) for part in parts))
    for name in formats:
        if name not in MESH_FILES:
            raise argparse.ArgumentTypeError(
                f"{name!r} is not a mesh format, expected one or more of {', '.join(MESH_FILES)}"
            )
    return formats


def _patch_types(text: str) -> dict[str, str]:
    """Return the types of patches in `text`, as NAME=TYPE separated by commas."""
    found = {}
    for part in text.split(","):
        name, separator, kind = (word.strip() for word in part.partition("="))
        if not (name and separator and kind):
            raise argparse.ArgumentTypeError(f"{part!r} is not NAME=TYPE, expected such as inlet=patch,outlet=patch")
        found[name] = kind
    return found


def _path(text: str) -> Path:
    """Return `text` as a path. An empty text, as from an unset variable of a script, is an error."""
    if not text:
        raise argparse.ArgumentTypeError("it is empty, expected a name")
    return Path(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    with steady_streams() as out:
        code = _carry_out(argv)
        out.flush()
        if out.error is not None and not isinstance(out.error, BrokenPipeError):
            lost = f"cannot write to the standard output: {out.error.strerror or out.error}"
            code = _complain(lost, code or FAILED)
    return code


def _carry_out(argv: Sequence[str] | None) -> int:
    """Run one command; turn errors into a message and an exit code."""
    peers, speaks, shares = ALONE, may_speak(), False
    try:
        with nullcontext() if speaks else _silence():
            arguments = build_parser().parse_args(argv)
        arguments.given = sys.argv[1:] if argv is None else argv
        shares = arguments.work is _run
        if shares:
            arguments.peers = peers = this_rank()
        with warnings.catch_warnings(), nullcontext() if peers.number == 0 else _silence():
            warnings.showwarning = _warning_printer()
            return arguments.work(arguments)
    except (Exception, KeyboardInterrupt, Aborted) as error:
        peers.fail(error)
        message, code = _explain(error)
        if shares and peers.count == 1 and not speaks:
            return code
        return end_together(peers, code, lambda: _complain(message, code))


@contextmanager
def _silence() -> Iterator[None]:
    """Discard all output of this rank, since rank 0 prints the same."""
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield


def _explain(error: BaseException) -> tuple[object, int]:
    """Return the message for `error` and the exit code. Raise all errors again that are faults of clvoro itself."""
    try:
        raise error
    except (OutputError, BuildError):
        return error, FAILED
    except (InputError, InputTypeError):
        return error, BAD_INPUT
    except DeviceError:
        return error, NO_DEVICE
    except PermissionError as closed:  # of a folder on the way to a file
        return f"cannot reach {closed.filename}: {closed.strerror}", BAD_INPUT
    except (ClvoroError, OSError):
        return error, FAILED
    except MemoryError:
        return f"the host is out of memory ({error}); give the process more, or ask for fewer cells", FAILED
    except (KeyboardInterrupt, Aborted):
        return "interrupted, nothing more has been written", INTERRUPTED


def _warning_printer() -> Callable[..., None]:
    """Return a function that prints each warning once, without the place in the code."""
    printed: set[str] = set()

    def show(message: Warning | str, *_: object) -> None:
        text = f"clvoro: warning: {message}"
        if text not in printed:
            printed.add(text)
            print(text, file=sys.stderr)

    return show


def _complain(message: object, code: int) -> int:
    print(f"clvoro: {message}", file=sys.stderr)
    return code


def _run(arguments: argparse.Namespace) -> int:
    from .cases import load_case
    from .jobs import Job
    from .progress import during

    work = f"{Path(arguments.case).stem}: preparing the domain"
    read = partial(during, work, arguments.quiet, lambda: load_case(arguments.case))
    case = arguments.peers.agree(read, lambda case: {"case": case.text()})
    methods = [] if arguments.method is None else arguments.method.split(",")
    case = case.with_run(
        method=methods[0] if len(methods) == 1 else None,
        methods=methods if len(methods) > 1 else None,
        levels=_level_count(arguments.levels),
        **_taken(arguments, "start", "n_cells", "max_steps", "tol", "k", "seed", "dtype", "effort"),
    )
    arguments.out = arguments.out or Path("out") / case.name
    arguments.picture_formats = tuple(arguments.picture_formats or ["png"])
    given = _taken(arguments, *(option.name for option in fields(Job) if option.init))
    job = Job(**given | {"case": case, "command": tuple(arguments.given)})
    if job.run():
        return INTERRUPTED
    return FAILED if job.rejected or job.missed else OK


def _taken(arguments: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the arguments of these names."""
    return {name: getattr(arguments, name) for name in names}


def _level_count(text: str | None) -> str | int | None:
    """Return the number in `text`; the checks of the case reject other texts than "auto"."""
    return int(text) if text is not None and text.isdecimal() else text


def _readable(name: str) -> str:
    """Return `name` if its suffix is that of a mesh that `load` reads."""
    from ..io.foam_read import refuse_polymesh

    refuse_polymesh(name)
    if Path(name).suffix.lower() not in (".npz", ".vtu", ".pvtu", ".nc", ".foam"):
        what = "is no mesh" if Path(name).exists() else "does not exist"
        raise InputError(
            f"{name} {what}, expected a .npz, .vtu, .pvtu or .nc file (to check, also .foam or a case's folder)"
        )
    return name


def _convert(arguments: argparse.Namespace) -> int:
    from ..io import load, write
    from .outputs import written_names
    from .progress import during

    mesh = load(_readable(arguments.mesh))
    options = {"convention": arguments.convention, "walls": arguments.walls, "types": arguments.types or None}
    options |= {"check": False if arguments.unchecked else None, "processors": arguments.processors}
    during(f"writing {arguments.out}", False, lambda: write(mesh, arguments.out, **options))
    print(f"written: {written_names(arguments.out)}")
    return OK


def _check(arguments: argparse.Namespace) -> int:
    import json

    from .progress import during

    code = OK
    for name in arguments.files:
        try:
            report = during(f"{name}: checking", False, partial(_verdict, name, arguments))
        except InputError as error:  # the other files are checked all the same
            code = _complain(error, BAD_INPUT)
            continue
        if arguments.json:
            print(json.dumps({"file": name, **report.as_dict()}), flush=True)
        else:
            print(f"{name}: {report}")
        code = code or (OK if report else FAILED)
    return code


def _verdict(name: str, arguments: argparse.Namespace) -> Any:
    """Return the report on one mesh file."""
    from ..io import load
    from ..io.foam import polymesh_folder
    from ..io.foam_read import check_polymesh

    folder = polymesh_folder(name)
    if folder is None:
        return load(_readable(name)).check(arguments.solver, walls=arguments.walls)
    if arguments.solver not in (None, "openfoam") or arguments.walls is not None:
        given = "--walls" if arguments.solver in (None, "openfoam") else f"--for {arguments.solver}"
        raise InputError(
            f"{name} is a mesh for OpenFOAM, and {given} is for mesh.npz and mesh.vtu of the same run; check those"
        )
    return check_polymesh(folder)


def _foam_adapt(arguments: argparse.Namespace) -> int:
    import dataclasses
    import json

    from ..adapter import Adapter
    from ..foam import FieldSizes, FoamCycle, adapt_case
    from ..opencl.devices import create_context

    def show(row: FoamCycle) -> None:
        if arguments.json:
            print(json.dumps(dataclasses.asdict(row)), flush=True)
            return
        text = f"cycle {row.cycle}: {row.cells:,} cells at {row.time:g}"
        text += "".join(f", {name} {value:.6g}" for name, value in row.monitors.items())
        if row.next_cells is not None:
            text += f"; next {row.next_cells:,} cells, predicted error {row.predicted_error:.3g}"
        seconds = (row.solver_seconds, row.mesh_seconds or 0, row.transfer_seconds or 0)
        print(f"{text}; {seconds[0]:.1f} s solver, {seconds[1]:.1f} s mesh, {seconds[2]:.1f} s transfer", flush=True)

    adapt_case(
        arguments.case,
        n_cells=arguments.cells,
        sizes=FieldSizes(**_taken(arguments, "fields", "forces", "adjoints", "p", "h_min", "h_max", "growth")),
        **_taken(arguments, "cycles", "solver", "interval", "window", "layers", "mesh", "effort"),
        pictures=not arguments.no_pictures,
        adapter=None if arguments.device is None else Adapter(create_context(arguments.device)),
        on_cycle=show,
    )
    return OK


def _devices(_: argparse.Namespace) -> int:
    from ..opencl.devices import format_devices, list_devices

    devices = list_devices()
    print(format_devices(devices))
    return OK if any(device.works for device in devices) else NO_DEVICE


def _cases(arguments: argparse.Namespace) -> int:
    from .cases import builtin_cases, load_case

    known = builtin_cases()
    if arguments.case is None:
        for name in known:
            print(f"{name:10} {load_case(name).title}")
    elif arguments.case in known:
        print(known[arguments.case], end="")
    else:
        raise InputError(f"case is {arguments.case!r}, expected one of the built-in cases {', '.join(known)}")
    return OK
