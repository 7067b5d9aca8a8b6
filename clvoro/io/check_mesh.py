"""OpenFOAM's own verdict: run its `checkMesh` on a mesh."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ..finite_volumes.solver_mesh import WallShape
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .contents import Contents
from .foam import write_foam

_DEBIAN = Path("/usr/share/openfoam")
"""Where Debian's package has its settings; other installations set WM_PROJECT_DIR."""
_SCHEMES = ("ddt", "grad", "div", "laplacian", "interpolation", "snGrad")
_SYSTEM = {
    "controlDict": "startTime 0; endTime 1; deltaT 1; writeInterval 1;",
    "fvSchemes": " ".join(f"{scheme}Schemes {{ default none; }}" for scheme in _SCHEMES),
    "fvSolution": "",
}


@dataclass(frozen=True)
class CheckMeshResult:
    """What `checkMesh` says."""

    ok: bool
    """Whether it prints "Mesh OK"."""
    complaints: tuple[str, ...]
    """Its lines with three stars."""
    text: str
    """All that it prints."""


def run_check_mesh(mesh: Result | Diagram, walls: WallShape = "straight") -> CheckMeshResult | None:
    """Return the verdict of OpenFOAM's `checkMesh` on a mesh, or None if it is not installed.

    The mesh is written into a temporary case.
    """
    if shutil.which("checkMesh") is None:
        return None
    with tempfile.TemporaryDirectory(prefix="clvoro-") as name:
        case = Path(name)
        write_foam(Contents.of(mesh), case / "constant" / "polyMesh", walls=walls, check=False)
        return check_case(case)


def check_case(case: Path, thorough: bool = True) -> CheckMeshResult:
    """Return the verdict of `checkMesh`, which is installed, on the mesh of a case; its folder `system` is written.

    It is asked `thorough`ly with the options ``-allGeometry -allTopology``.
    """
    (case / "system").mkdir(exist_ok=True)
    for file, text in _SYSTEM.items():
        head = f"FoamFile {{ version 2.0; format ascii; class dictionary; object {file}; }}\n"
        (case / "system" / file).write_text(head + text + "\n", encoding="ascii")
    settings = {"WM_PROJECT_DIR": str(_DEBIAN)} if _DEBIAN.is_dir() else {}
    command = ["checkMesh", *(("-allGeometry", "-allTopology") if thorough else ()), "-case", str(case)]
    done = subprocess.run(command, env={**settings, **os.environ}, capture_output=True, text=True, check=False)
    text = done.stdout + done.stderr
    stars = re.findall(r"^ *\*\*\*(.*)$", text, re.MULTILINE)
    return CheckMeshResult("Mesh OK." in text, tuple(line.strip() for line in stars), text)
