"""The house as it is laid out: what imports and includes what, kernels and their names, and how kernels are written."""

import ast
import collections
import functools
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import clvoro
from clvoro.opencl.program import kernel_folder

PACKAGE = Path(clvoro.__file__).parent
KERNELS = kernel_folder()
SOURCES = sorted([*KERNELS.rglob("*.cl"), *KERNELS.rglob("*.h")])
HERE = Path(__file__).parent
HOUSE = PACKAGE.parent
CLANG_FORMAT = "14"
"""The version whose style is the kernels': others break some lines elsewhere."""
ORDER = (
    "version",
    "errors",
    "arguments",
    "files",
    "connectivity",
    "opencl",
    "geometry",
    "curves",
    "mesh",
    "finite_volumes",
    "io",
    "sizing",
    "tessellation",
    "solvers",
    "adaptation",
    "remapping",
    "plotting",
    "earth",
    "adapter",
    "shared",
    "foam",
    "fields",
    "__init__",
    "cli",
    "__main__",
)
"""Packages and root modules: each imports only from those before it."""
UPWARD = {
    ("mesh.quality", "earth"),
    ("mesh.diagram", "finite_volumes"),
    ("mesh.faces", "finite_volumes"),
    ("mesh.output", "finite_volumes"),
    ("mesh.output", "io"),
    ("mesh.output", "plotting"),
    ("mesh.output", "remapping"),
}
"""Imports against the order, all inside methods of `Result`, `Diagram` and `Measures`: save, plot, check, transfer."""
MOST_IN_ROOT, MOST_IN_PACKAGE = 12, 25
"""Files directly in `clvoro/`, and in each of its folders."""
DOMAINS = {"Box", "Polygon", "Sphere", "SphereRegion"}
KINDS = {"outline", "curved", "cuts_cells", "globe", "curved_walls", "plain", "wall_triangles"}
MOST_TYPE_TESTS, MOST_DIMENSIONS, MOST_KINDS = 3, 40, 110
"""Tests of a domain's type outside of `geometry`, comparisons of a dimension, and uses of the attributes by which
domains differ: all ask what a domain should say."""
OF_DOMAINS = re.compile("polygon|sphere|periodic|weight", re.I)
"""Words that the lowest package does not know."""
OF_KERNELS = re.compile(r"\bkernels\b(\(.*\)|\[.*\])?\)?$|\b_kernels\b(\(.*\)|\[.*\])?$")
"""An expression in Python that stands for the kernels of a file."""
PARTS = {
    "solvers.poisson": {"solvers.conjugate_gradient", "solvers.multigrid"},
    "solvers.multigrid": {"solvers.aggregation"},
    "solvers.transport": {"solvers.poisson"},
    "tessellation.cells": {"tessellation.part"},
    "tessellation.polyhedra": {"tessellation.part"},
    "tessellation.periodic.ghost_images": {"tessellation.part"},
    "tessellation.incremental": {"tessellation.cells"},
    "tessellation.polyhedra_update": {"tessellation.polyhedra"},
}
"""Modules with kernels that use the kernels of others."""
RETURN_TOGETHER = {"tessellation/polyhedra_by_teams"}
"""Files of kernels whose work-groups return as one, from any place; see tessellation/team.h."""


def name_of(path):
    return path.relative_to(KERNELS).as_posix()


@functools.cache
def text_of(path):
    return path.read_text()


@functools.cache
def code_of(path):
    """Return the text of kernels without comments."""
    return re.sub(r"/\*.*?\*/|//[^\n]*", " ", text_of(path), flags=re.S)


@functools.cache
def functions(path):
    """Return the functions of one file as [(name, body, is it a kernel)]."""
    found, code = [], code_of(path)
    for head in re.finditer(r"^(inline|kernel) [^;{}#]*?\b(\w+)\(", code, re.M):
        begin = code.index("{", head.end())
        depth, end = 1, begin + 1
        while depth:
            depth += {"{": 1, "}": -1}.get(code[end], 0)
            end += 1
        found.append((head[2], code[begin:end], head[1] == "kernel"))
    return found


@functools.cache
def macros(path):
    """Return the macros of one file as [(name, replacement)]."""
    pattern = r"^[ \t]*#define (\w+)(?:\([^)]*\))?((?:[^\n]*\\\n)*[^\n]*)"
    return re.findall(pattern, code_of(path), re.M)


@functools.cache
def unit(path):
    """Return the files that make a program of `path`: itself and what it includes."""
    found = [path]
    for header in re.findall(r'^#include "([^"]+)"', text_of(path), re.M):
        found += [other for other in unit(KERNELS / header) if other not in found]
    return found


def kernels_of(stage):
    """Return the names of a stage's kernels."""
    files = unit(KERNELS / f"{stage}.cl")
    return {name for path in files for name, _, is_kernel in functions(path) if is_kernel}


@functools.cache
def modules():
    """Return all modules of the package as {name: syntax tree}, without the package's own name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        found[name] = ast.parse(text_of(path))
    return found


def source_of(module, node=None):
    """Return the text of a module, or of a statement in it. Syntax trees are slow to write out again."""
    text = text_of(PACKAGE / (module.replace(".", "/") + ".py"))
    return text if node is None else "\n".join(text.splitlines()[node.lineno - 1 : node.end_lineno])


def import_statements(node, lazy):
    typing = isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
    if typing or (isinstance(node, ast.FunctionDef) and not lazy):
        return
    if isinstance(node, ast.ImportFrom):
        yield node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.stmt, ast.ExceptHandler)):
            yield from import_statements(child, lazy)


def imports(name, tree, known, lazy=False):
    """Return which modules of the package are imported when `name` is, with the imported names: {module: names}.

    With `lazy`, those imported inside functions, too; never those for type checkers only.
    """
    found = {}
    package = name.split(".")[:-1]
    for node in import_statements(tree, lazy):
        if not node.level:
            continue
        base = package[: len(package) - (node.level - 1)] + (node.module or "").split(".")
        base = [part for part in base if part]
        for alias in node.names:
            whole = ".".join([*base, alias.name])
            if whole not in known:
                whole = ".".join([*base, alias.name, "__init__"])
            if whole not in known:
                whole = ".".join(base)
                whole = whole if whole in known else ".".join([*base, "__init__"])
            assert whole in known, f"{name} imports {whole}"
            found.setdefault(whole, set()).add(alias.name)
    return found


def stages():
    """Return the files of kernels as Python names them: their path without the suffix."""
    return {path.relative_to(KERNELS).with_suffix("").as_posix() for path in KERNELS.rglob("*.cl")}


# Modules.


def test_packages_import_only_from_those_before_them():
    trees = modules()
    against = set()
    for name, tree in trees.items():
        top = name.split(".")[0]
        for need in imports(name, tree, trees, lazy=True):
            below = need.split(".")[0]
            if ORDER.index(below) > ORDER.index(top):
                against.add((name, below))
    assert against == UPWARD


def test_modules_import_each_other_in_no_circle():
    trees = modules()
    left = {name: set(imports(name, tree, trees)) for name, tree in trees.items()}
    assert len(left) > 80
    while True:
        ground = {name for name, needs in left.items() if not needs & set(left) - {name}}
        if not ground:
            break
        for name in ground:
            del left[name]
    assert not left, "modules that import each other, or import such modules"


def words_in(node):
    """Return the names and attributes in an expression."""
    nodes = list(ast.walk(node))
    return {n.id for n in nodes if isinstance(n, ast.Name)} | {n.attr for n in nodes if isinstance(n, ast.Attribute)}


def test_domains_are_asked_not_told_apart():
    """Whoever adds a domain writes one class: others ask it, and neither test its type nor compare its dimension."""
    types, dimensions, kinds = [], [], []
    for module, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in KINDS and not module.startswith("geometry."):
                if ast.unparse(node.value) not in ("self", "bar"):  # which have others of these names
                    kinds.append(f"{module}: {ast.unparse(node)}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
                if words_in(node.args[1]) & DOMAINS and not module.startswith("geometry."):
                    types.append(f"{module}: {ast.unparse(node)}")
            elif isinstance(node, ast.Compare):
                sides = [node.left, *node.comparators]
                names = {getattr(side, "id", getattr(side, "attr", "")) for side in sides}
                if names & {"dim", "cell_dim"} and any(isinstance(side, ast.Constant) for side in sides):
                    dimensions.append(f"{module}: {ast.unparse(node)}")
    assert len(types) <= MOST_TYPE_TESTS, types
    assert len(dimensions) <= MOST_DIMENSIONS, dimensions
    assert len(kinds) <= MOST_KINDS, collections.Counter(kinds)


def test_packages_of_scipy_are_imported_when_they_are_used():
    """`import scipy` alone imports none of them, so that `import clvoro` need not wait for them."""
    found = [path for path in PACKAGE.rglob("*.py") if re.search(r"^(from|import) scipy[. ]", path.read_text(), re.M)]
    assert not found


def test_classes_have_names_of_their_own():
    found = collections.defaultdict(list)
    for module, tree in modules().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                found[node.name].append(module)
    assert len(found) > 200, "no classes are found any more"
    assert {name: where for name, where in found.items() if len(where) > 1} == {}


def test_devices_know_no_domains():
    """The lowest package builds kernels for macros and arguments, whatever they mean."""
    files = [path for path in PACKAGE.glob("opencl/*.py") if OF_DOMAINS.search(text_of(path))]
    assert files == []


def test_writers_take_the_one_mesh():
    """`Contents` holds a diagram and data of its cells; all else, such as edges and half-faces, are its views."""
    takes = {
        f"{module}.{node.name}": ast.unparse(node.args.args[0].annotation or node)
        for module, tree in modules().items()
        if module.split(".")[0] in ("io", "earth")
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("write_")
    }
    assert len(takes) > 8
    others = {name for name, first in takes.items() if first != "Contents"}
    assert others == {"io.arrays.write_arrays", "io.convert.write_history"}


def test_the_formatter_is_never_skipped():
    folders = [folder for folder in (PACKAGE, HERE, HOUSE / "bench", HOUSE / "docs") if folder.is_dir()]
    mark = "# fmt: " + "skip"
    assert [path for folder in folders for path in folder.rglob("*.py") if mark in path.read_text()] == []


def test_folders_stay_small():
    folders = collections.Counter(path.parent for path in PACKAGE.rglob("*.py"))
    assert folders.pop(PACKAGE) <= MOST_IN_ROOT
    assert max(folders.values()) <= MOST_IN_PACKAGE


def test_kernels_and_tests_have_the_folders_of_the_package():
    packages = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*") if (path / "__init__.py").is_file()}
    kernels = {path.parent.relative_to(KERNELS).as_posix() for path in SOURCES}
    assert kernels - {"simd"} <= packages
    tests = {path.parent.relative_to(HERE).as_posix() for path in HERE.rglob("test_*.py")}
    assert tests - {".", "robustness"} <= packages


def test_modules_with_kernels_use_no_others():
    """But for what they hand on (data, constants), and for those that consist of others (`PARTS`)."""
    trees = modules()
    makers = {  # classes that have kernels
        name: {n.name for n in tree.body if isinstance(n, ast.ClassDef) and ".kernels(" in source_of(name, n)}
        for name, tree in trees.items()
    }
    makers = {name: classes for name, classes in makers.items() if classes and not name.startswith("opencl")}
    seen = set()
    for name in makers:
        for other, taken in imports(name, trees[name], trees).items():
            if taken & makers.get(other, set()):
                assert other in PARTS.get(name, ()), f"{name} imports {taken} of {other}"
                seen.add((name, other))
    assert seen == {(name, part) for name, parts in PARTS.items() for part in parts}


# Files of kernels.


def test_every_header_is_used():
    included = {path for stage in stages() for path in unit(KERNELS / f"{stage}.cl")}
    by_python = {
        KERNELS / name
        for tree in modules().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in re.findall(r"^\w+(?:/\w+)+\.h$", node.value)
    }
    assert included | by_python == set(SOURCES)


def test_nothing_is_defined_in_vain():
    """Functions and macros are used somewhere beside their definitions; kernels: see below."""
    counts = collections.Counter(w for path in SOURCES for w in re.findall(r"\w+", code_of(path)))
    defined = collections.Counter(
        name
        for path in SOURCES
        for name in [
            *(name for name, _, is_kernel in functions(path) if not is_kernel),
            *(name for name, _ in macros(path)),
        ]
    )
    asked = collections.Counter(
        name
        for path in SOURCES
        for name in re.findall(r"^[ \t]*#ifn?def (\w+)", code_of(path), re.M)
        if name in defined
    )
    assert len(defined) > 300, "the patterns find nothing any more"
    vain = {name for name in defined if counts[name] <= defined[name] + asked[name]}
    # But for those that are put together, as by CLVORO_JOIN(NAME_, REAL), and of three kinds
    # the one that is neither of the others.
    together = re.compile("(?<=_)(double|float|int)$")
    vain -= {name for name in vain if together.search(name) and counts[together.sub("", name)]}
    # And but for what calls have in place of parameters: of POINT_ARGS, POINT or POINTS.
    vain -= {name for name in vain if {f"{name}_ARGS", f"{name.removesuffix('S')}_ARGS"} & set(defined)}
    assert vain == {"SIZE_ROUND"}


def test_kernels_are_those_that_python_asks_for():
    """Each kernel is named in a module that builds its file, and no other one is."""
    asked = {stage: set() for stage in stages()}
    for module, tree in modules().items():
        built = set(re.findall(r'\.kernels\(\s*"([\w/]+)"', source_of(module)))
        assert built <= stages(), module
        if not built:
            continue
        known = set().union(*map(kernels_of, built))
        sets = {"kernels", "_kernels"}  # names of variables and functions that have kernels
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign):
                pairs = [(node.targets[0], node.value)]
                if isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = zip(node.targets[0].elts, node.value.elts, strict=True)
                for target, value in pairs:
                    if isinstance(target, ast.Name) and OF_KERNELS.search(ast.unparse(value)):
                        sets.add(target.id)
        names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant):
                names.add(node.value)
            elif isinstance(node, ast.Attribute):
                names.add(node.attr)
                holder = re.sub(r"(\(.*\)|\[.*\])$", "", ast.unparse(node.value)).split(".")[-1]
                if holder in sets and node.attr not in (*dir(dict), "kernels"):
                    assert node.attr in known, f"{module} asks for {node.attr}"
        for stage in built:
            asked[stage] |= names
    asked["opencl/copy"] = kernels_of("opencl/copy")  # the only one: the profile takes what there is
    for stage in stages():
        assert kernels_of(stage), stage
        assert kernels_of(stage) <= asked[stage], f"{stage}: nobody asks for these"


def test_kernels_that_tests_name_exist():
    """Lists of "file.kernel" in tests, most of them slow ones."""
    stems = {path.stem: path for path in KERNELS.rglob("*.cl")}
    named = {
        (stem, kernel)
        for path in (HERE / "robustness/test_oclgrind.py", HERE / "robustness/test_sanitizers.py")
        for stem, kernel in re.findall(r'"(\w+)\.(\w+)"', text_of(path))
        if stem not in ("file", "tests", "trap")
    }
    assert len(named) > 30, "the pattern finds nothing any more"
    known = {stem: kernels_of(name_of(path)[:-3]) for stem, path in stems.items()}
    assert {f"{s}.{k}" for s, k in named if k not in known.get(s, ())} == set()


def test_no_kernel_returns_before_a_barrier():
    """Work-items that have returned would be waited for: PoCL fails at that with groups of more than one."""
    checked = set()
    for stage in stages() - RETURN_TOGETHER:
        files = unit(KERNELS / f"{stage}.cl")
        bodies = [(name, body) for path in files for name, body, _ in functions(path)]
        texts = [(name, body) for path in files for name, body in macros(path)]

        def reaching(names, texts):
            """Names of those which contain one of `names`, or another that does."""
            while True:
                pattern = re.compile(rf"(?<![.>\w])({'|'.join(sorted(names))})\b")
                more = {name for name, body in texts if pattern.search(body)} - names
                if not more:
                    return pattern
                names |= more

        waits = reaching({"barrier"}, bodies + texts)
        # A function that returns something ends itself, a macro that does so what it stands in.
        returns = reaching({"return"}, texts)
        for name, body in bodies:
            calls = [match.start() for match in waits.finditer(body)]
            if calls:
                checked.add((stage, name))
                # What a function that waits has found may be returned.
                before = re.sub(r"\breturn\b[^;]*$", "", body[: calls[-1]])
                assert not returns.search(before), (stage, name)
    assert {("solvers/conjugate_gradient", "solve_by_group"), ("solvers/poisson", "subtract_mean_source")} <= checked


def test_kernels_are_formatted():
    if not (HOUSE / ".clang-format").is_file():
        pytest.skip("the tests lie outside a source tree")
    if shutil.which("clang-format") is None:
        pytest.skip("needs clang-format")
    said = subprocess.run(["clang-format", "--version"], capture_output=True, text=True).stdout
    if re.search(rf"version {CLANG_FORMAT}\.", said) is None:
        pytest.skip(f"needs clang-format {CLANG_FORMAT}, this is {said.strip()}")
    done = subprocess.run(
        ["clang-format", "--dry-run", "--Werror", *map(str, SOURCES)], cwd=HOUSE, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", [p for p in SOURCES if p.suffix == ".cl"], ids=name_of)
def test_macros_of_kernels_are_not_those_of_their_headers(path):
    """A second definition is a warning on the terminal, and changes what the header means. Defaults are `#ifndef`."""
    own = {name for name, _ in macros(path)}
    for header in unit(path)[1:]:
        again = {name for name, _ in macros(header) if f"#ifndef {name}\n" not in text_of(header)}
        assert not own & again, name_of(header)


def test_names_of_kernels_and_functions_are_unique():
    """A name leads to one file; within it, variants by dimension may share the name."""
    files = collections.defaultdict(set)
    for path in SOURCES:
        for name, _, _ in functions(path):
            files[name].add(name_of(path))
    assert len(files) > 300, "the patterns find nothing any more"
    assert not {name for name, paths in files.items() if len(paths) > 1}
