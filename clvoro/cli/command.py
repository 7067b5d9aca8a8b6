"""The command `clvoro`: run a case, list devices and built-in cases."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from ..errors import (
    Aborted,
    BuildError,
    ClvoroError,
    DeviceError,
    InputError,
    InputTypeError,
    OutputError,
)
from .streams import steady_streams

OK, FAILED, BAD_INPUT, NO_DEVICE, INTERRUPTED = 0, 1, 2, 3, 130

_EPILOG = """\
exit codes:
  0    done
  1    the run failed, or a file could not be written; check: a mesh is wrong
  2    bad usage or input, also a place where no folder can be made (--out);
       check: a file cannot be read
  3    no usable device
  130  interrupted (Ctrl-C, SIGTERM, SIGHUP, SIGXCPU; what there was has been
       written)

examples:
  clvoro run paper                      the paper's validation case, into out/paper
  clvoro run airfoil --device gpu       a wing section on a GPU
  clvoro cases paper > my.toml          a case file to start from
  clvoro run my.toml --effort fast --out result
  clvoro run my.toml --checkpoint my.state                   and, should it be killed,
  clvoro run my.toml --checkpoint my.state --resume my.state
  clvoro check result/mesh.vtu          is the mesh what it claims to be?
"""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="clvoro",
        description="Adapt Voronoi meshes to a size field, with OpenCL on any CPU or GPU.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"clvoro {_version()}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    run = commands.add_parser(
        "run",
        help="run a case: mesh, history and report",
        description="Run a case and write mesh.vtu, mesh.npz, history.csv, case.toml, report.html and\n"
        "pictures/. Options override what the case says.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("case", metavar="CASE", help="a TOML file, or a built-in case's name")
    run.add_argument(
        "--out", metavar="DIR", type=_path, help="where to write (default: out/NAME of the case)"
    )
    run.add_argument(
        "--device", metavar="NAME", help="gpu, cpu, part of a name, or PLATFORM:DEVICE indices"
    )
    run.add_argument(
        "--method",
        metavar="M",
        help="adaptive (the default), exact, or one kind of step: coupled (the paper's), lloyd, "
        "poisson, weighted-lloyd, weighted; or several: lloyd,coupled",
    )
    run.add_argument(
        "--start", choices=("density", "uniform"), help="random start: by h^-d, or uniform"
    )
    run.add_argument("--cells", metavar="N", type=int, help="number of cells (default: from h)")
    run.add_argument("--steps", metavar="N", type=int, help="largest number of steps")
    repeated = "(methods of one kind of step)"
    run.add_argument(
        "--tol", type=float, metavar="T", help=f"stop when gains fall below this share {repeated}"
    )
    run.add_argument(
        "--k", type=float, metavar="K", help=f"largest displacement over h in a step {repeated}"
    )
    run.add_argument("--seed", type=int, metavar="S", help="of the random start")
    run.add_argument("--dtype", choices=("float64", "float32"), help="precision on the device")
    run.add_argument(
        "--effort",
        choices=("fast", "default", "best"),
        help="work against quality (adaptive, exact)",
    )
    run.add_argument(
        "--levels",
        metavar="N",
        help="coarser levels to begin with, or auto (the default; adaptive, exact)",
    )
    run.add_argument(
        "--checkpoint",
        metavar="FILE",
        type=_path,
        help="write the run's state there every so often",
    )
    run.add_argument(
        "--checkpoint-every", metavar="SECONDS", type=float, help="time between (default: 60)"
    )
    run.add_argument(
        "--resume", metavar="FILE", type=_path, help="go on from a checkpoint of the same case"
    )
    run.add_argument("--no-report", action="store_true", help="no pictures and no page")
    run.add_argument(
        "--format",
        metavar="KIND",
        action="append",
        choices=("png", "pdf", "svg"),
        help="kind of picture files, may be repeated (default: png)",
    )
    run.add_argument(
        "--profile", action="store_true", help="print where the time goes, by stage and by kernel"
    )
    run.add_argument("--quiet", "-q", action="store_true", help="print errors only")
    run.add_argument("--json", action="store_true", help="print one JSON object per finished run")

    check = commands.add_parser(
        "check",
        help="verify meshes: volumes, graph, faces, the Voronoi property, error and quality",
        description="Verify meshes that clvoro wrote, on the host alone: prints what does not hold, and where. "
        "Exit code 0: all is right; 1: something is wrong; 2: a file cannot be read.",
    )
    check.add_argument("files", metavar="FILE", nargs="+", help="mesh.npz or mesh.vtu")
    check.add_argument("--json", action="store_true", help="print one JSON object per file")
    commands.add_parser("devices", help="list the OpenCL devices and whether they work")
    cases = commands.add_parser("cases", help="list the built-in cases, or print one")
    cases.add_argument("case", metavar="NAME", nargs="?", help="print this case's TOML text")
    return parser


def _path(text: str) -> Path:
    """Return `text` as a path: an empty one, of a script's variable that is not set, would be the working folder."""
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
    """Do what is asked for, and turn what goes wrong into a message and an exit code."""
    try:
        arguments = build_parser().parse_args(argv)
        command = {"run": _run, "check": _check, "devices": _devices, "cases": _cases}[
            arguments.command
        ]
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return command(arguments)
    except (OutputError, BuildError) as error:
        return _complain(error, FAILED)
    except (InputError, InputTypeError) as error:
        return _complain(error, BAD_INPUT)
    except DeviceError as error:
        return _complain(error, NO_DEVICE)
    except (ClvoroError, OSError) as error:
        return _complain(error, FAILED)
    except MemoryError as error:
        remedy = "give the process more, or ask for fewer cells"
        return _complain(f"the host is out of memory ({error}); {remedy}", FAILED)
    except (KeyboardInterrupt, Aborted):
        return _complain("interrupted, nothing more has been written", INTERRUPTED)


def _show_warning(message: Warning | str, *_: object) -> None:
    """Print a warning without the place in the code, which says nothing to people."""
    print(f"clvoro: warning: {message}", file=sys.stderr)


def _complain(message: object, code: int) -> int:
    print(f"clvoro: {message}", file=sys.stderr)
    return code


def _version() -> str:
    from .. import __version__

    return __version__


def _run(arguments: argparse.Namespace) -> int:
    from .cases import load_case
    from .jobs import Job

    case = load_case(arguments.case)
    methods = [] if arguments.method is None else arguments.method.split(",")
    case = case.with_run(
        method=methods[0] if len(methods) == 1 else None,
        methods=methods if len(methods) > 1 else None,
        start=arguments.start,
        n_cells=arguments.cells,
        max_steps=arguments.steps,
        tol=arguments.tol,
        k=arguments.k,
        seed=arguments.seed,
        dtype=arguments.dtype,
        effort=arguments.effort,
        levels=_level_count(arguments.levels),
    )
    job = Job(
        case,
        arguments.out or Path("out") / case.name,
        device=arguments.device,
        report=not arguments.no_report,
        formats=tuple(arguments.format or ["png"]),
        quiet=arguments.quiet,
        as_json=arguments.json,
        profile=arguments.profile,
        checkpoint=arguments.checkpoint,
        checkpoint_every=arguments.checkpoint_every,
        resume=arguments.resume,
    )
    return INTERRUPTED if job.run() else OK


def _level_count(text: str | None) -> str | int | None:
    """Return the number in `text`; what is none is for the case's checks to refuse."""
    return int(text) if text is not None and text.isdecimal() else text


def _check(arguments: argparse.Namespace) -> int:
    import json

    from ..io import load

    code = OK
    for name in arguments.files:
        path = Path(name)
        try:
            if path.suffix.lower() not in (".npz", ".vtu"):
                raise InputError(
                    f"{name} is no mesh.npz and no mesh.vtu, which are what can be checked"
                )
            report = load(path).check()
        except InputError as error:  # the other files are looked at all the same
            code = _complain(error, BAD_INPUT)
            continue
        if arguments.json:
            print(json.dumps({"file": name, **report.as_dict()}), flush=True)
        else:
            print(f"{name}: {report}")
        code = code or (OK if report else FAILED)
    return code


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
        raise InputError(
            f"case is {arguments.case!r}, expected one of the built-in cases {', '.join(known)}"
        )
    return OK
