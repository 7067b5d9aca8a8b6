"""Hostile files (truncated, huge, with code) are refused with a clear error, and do no harm."""

import io
import json
import os
import pickle
import re
import struct
import time
import tracemalloc
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.checkpoint import Saved
from clvoro.cli.cases import load_case
from clvoro.cli.cases.files import LONGEST, read_toml
from clvoro.cli.cases.schema import load_array
from clvoro.errors import InputError
from clvoro.files import read_text
from clvoro.geometry import rings
from clvoro.io.vtu_read import load_vtu
from clvoro.sizing import Expression
from tests.robustness import fuzz_files as files

BOX = clvoro.Box((0, 0), (1, 1))


class Bomb:
    """Unpickling it makes a folder, as it could run any program."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        import os

        return os.mkdir, (str(self.path),)


@pytest.fixture(scope="module")
def result(ctx):
    points = np.random.default_rng(91).random((40, 2))
    return clvoro.Adapter(ctx).run(BOX, 0.15, points=points, method="lloyd", max_steps=1)


def member(array, pickled=False):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=pickled)
    return stream.getvalue()


def header(description):
    """The head of a `.npy` file, with arbitrary entries."""
    text = description.encode() + b" " * (64 - len(description) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


HUGE = header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 2), }")


@pytest.mark.parametrize("suffix", ["npz", "vtu"])
def test_every_cut_is_refused(result, tmp_path, suffix):
    path = tmp_path / f"m.{suffix}"
    result.save(path)
    data = path.read_bytes()
    reader = clvoro.load if suffix == "npz" else load_vtu
    for length in {*range(0, len(data), max(1, len(data) // 40)), len(data) - 60}:
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=re.escape(str(path))):
            reader(path)


def test_pickles_are_not_opened(result, tmp_path):
    trap = np.array([Bomb(tmp_path / "exploded")], dtype=object)
    result.save(tmp_path / "m.npz")
    with zipfile.ZipFile(tmp_path / "m.npz") as old, zipfile.ZipFile(tmp_path / "t.npz", "w") as new:
        for info in old.infolist():
            trapped = info.filename == "quality.npy"
            new.writestr(info.filename, member(trap, True) if trapped else old.read(info))
    with pytest.raises(InputError, match="pickled"):
        clvoro.load(tmp_path / "t.npz")
    (tmp_path / "a.npy").write_bytes(member(trap, True))
    (tmp_path / "b.npy").write_bytes(pickle.dumps(Bomb(tmp_path / "exploded")))
    for name in ("a.npy", "b.npy"):
        with pytest.raises(InputError):
            load_array(tmp_path / name, "run.points")
    assert not (tmp_path / "exploded").exists()


def test_headers_that_ask_for_terabytes_are_refused(tmp_path):
    (tmp_path / "a.npy").write_bytes(HUGE + b"\0" * 64)
    with pytest.raises(InputError, match="does not have the length"):
        load_array(tmp_path / "a.npy", "size.file")
    with zipfile.ZipFile(tmp_path / "m.npz", "w") as archive:
        archive.writestr("format.npy", HUGE)
        archive.writestr("version.npy", member(1))
    with pytest.raises(InputError, match="does not have the length"):
        clvoro.load(tmp_path / "m.npz")


@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '<f8', 'shape': ",
        "[" * 500,
        "__import__('os').mkdir('x')",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (9,), }",
        "{'descr': '<f8', 'fortran_order': 0, 'shape': (-1,), }",
    ],
)
def test_headers_that_are_none_are_refused(tmp_path, text):
    (tmp_path / "a.npy").write_bytes(header(text) + b"\0" * 64)
    with pytest.raises(InputError, match=r"size\.file"):
        load_array(tmp_path / "a.npy", "size.file")


def test_zip_bombs_are_refused(tmp_path):
    zeros = HUGE.replace(b"1000000000000, 2", b"       6250000,") + bytes(50_000_000)
    with zipfile.ZipFile(tmp_path / "m.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", zeros)
        archive.writestr("format.npy", member("clvoro-result"))
        archive.writestr("version.npy", member(1))
    assert (tmp_path / "m.npz").stat().st_size < 1e6
    for read in (clvoro.load, lambda path: load_array(path, "run.points")):
        with pytest.raises(InputError, match="expand to"):
            read(tmp_path / "m.npz")


VTU = """<?xml version="1.0"?>
%s<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64" \
compressor="vtkZLibDataCompressor">
<UnstructuredGrid><Piece NumberOfPoints="%s" NumberOfCells="1">
<Points><DataArray type="Float64" NumberOfComponents="3" format="appended" offset="0"/></Points>
</Piece></UnstructuredGrid>
<AppendedData encoding="raw">
_"""
TAIL = b"\n</AppendedData>\n</VTKFile>\n"
LAUGHS = (
    '<!DOCTYPE lolz [<!ENTITY lol "lol">'
    + "".join(f'<!ENTITY lol{k} "{f"&lol{k - 1 if k > 1 else str()};" * 10}">' for k in range(1, 10))
    + "]>"
)
SPY = '<!DOCTYPE x [<!ENTITY x SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize("doctype", [LAUGHS, SPY, "<!DOCTYPE html>"], ids=["laughs", "file", "any"])
def test_entities_are_refused(tmp_path, doctype):
    path = tmp_path / "m.vtu"
    path.write_bytes((VTU % (doctype, "&lol9;")).encode() + b"\0" * 100 + TAIL)
    began = time.monotonic()
    with pytest.raises(InputError, match="document type"):
        load_vtu(path)
    assert time.monotonic() - began < 5


def test_vtu_bombs_and_lies_are_refused(tmp_path):
    path = tmp_path / "m.vtu"
    block = zlib.compress(bytes(1 << 20), 9)

    def write(count, block_size, partial, sizes, blocks, points=1):
        table = struct.pack(f"<{3 + len(sizes)}Q", count, block_size, partial, *sizes)
        path.write_bytes((VTU % ("", points)).encode() + table + blocks + b"\n</AppendedData>\n</VTKFile>\n")

    lies = {
        "expands to more": (300, 1 << 20, 0, [len(block)] * 300, block * 300),
        "is truncated": (1 << 60, 1 << 20, 0, [], b""),
        "has blocks of": (1, 1 << 40, 0, [len(block)], block),
        "does not have the length|expands to more": (1, 1 << 19, 0, [len(block)], block),
        "is truncated|expands to more": (1, 1 << 20, 0, [1 << 50], block),
    }
    for message, content in lies.items():
        write(*content)
        with pytest.raises(InputError, match=message):
            load_vtu(path)
    write(1, 1 << 20, 0, [len(block)], block, points=10**18)
    with pytest.raises(InputError):
        load_vtu(path)


def peak(work):
    """Return the peak of the memory of Python and NumPy during `work`, which raises an error."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_many_arrays_in_the_same_bytes_are_refused(tmp_path):
    """Unused members are not read. Used ones must neither be repeated nor overlap."""
    path, rows = tmp_path / "m.vtu", 1 << 16
    raw = np.random.default_rng(5).random(rows).tobytes()
    block = zlib.compress(raw, 1)
    data = struct.pack("<4Q", 1, len(raw) + 1, len(raw), len(block)) + block

    def write(names):
        arrays = "".join(f'<DataArray type="Float64" Name="{name}" format="appended" offset="0"/>' for name in names)
        text = (VTU % ("", 1)).replace("</Piece>", f"<Cells></Cells></Piece><FieldData>{arrays}</FieldData>")
        path.write_bytes(text.replace('offset="0"/></Points>', 'offset="8"/></Points>').encode() + data + TAIL)

    write([f"a{k}" for k in range(200)])
    head = 1 << 22  # bytes that are read for it
    assert peak(lambda: load_vtu(path)) < head + 4 * len(raw)
    write(["bridges"] * 2)
    with pytest.raises(InputError, match="two arrays"):
        load_vtu(path)


def test_arrays_that_lie_in_each_other_are_refused(result, tmp_path):
    result.save(tmp_path / "m.vtu")
    data = (tmp_path / "m.vtu").read_bytes()
    load_vtu(tmp_path / "m.vtu")
    for name in ("size", "error", "quality", "volume"):
        data = re.sub(rb'(Name="%s".*?offset=)"\d+"' % name.encode(), rb'\1"0"', data)
    (tmp_path / "m.vtu").write_bytes(data)
    with pytest.raises(InputError, match=r"size has \d+ entries|arrays overlap"):
        load_vtu(tmp_path / "m.vtu")


def test_results_that_expand_more_than_honest_ones_are_refused(tmp_path):
    rows, rng = 1 << 20, np.random.default_rng(3)
    with zipfile.ZipFile(tmp_path / "m.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("format.npy", member("clvoro-result"))
        archive.writestr("version.npy", member(1))
        archive.writestr("points.npy", member(np.zeros((rows, 2))))
        archive.writestr("size.npy", member(rng.random(rows // 20)))
    path = tmp_path / "m.npz"
    assert peak(lambda: clvoro.load(path)) < 3 * path.stat().st_size
    with pytest.raises(InputError, match="more than 16 times"):
        clvoro.load(path)
    # The packed sizes in the archive's directory do not matter.
    data, said = path.read_bytes(), struct.pack("<L", 1 << 30)
    at = data.rindex(b"PK\x01\x02")
    (tmp_path / "m.npz").write_bytes(data[: at + 20] + said + data[at + 24 :])
    with pytest.raises(InputError, match="more than 16 times"):
        clvoro.load(path)


INJECTIONS = [
    "__import__('os').system('true')",
    "x.__class__",
    "(lambda: 1)()",
    "exec('1')",
    "x; y",
    "x\ny; }",
    "1 /* */ + x",
    "x // y",
    "#include <x>",
    "get_global_id(0)",
    "data[0]",
    "x[0]",
    "*data",
    "&x",
    "printf(x)",
    "as_double(x)",
    "x = 1",
    "x++",
    "1e999",
    "0x10",
    "1f",
    "'a'",
    '"a"',
    "x ? y",
    "s1",
    "size_at(x, data)",
    "asm(1)",
    "x\\\n",
    "\0",
    "x\u2028y",
    "\uff58 + 1",
    "x" * 5000,
    "(" * 3000 + "x" + ")" * 3000,
    "-" * 4000,
    "",
    "1 ? " * 60 + "x",
    "M_E",
    "true",
    "x if y else z",
    "x**2",
    "{x}",
    "x@y",
    "`x`",
    "$x",
]


@pytest.mark.parametrize("text", INJECTIONS, ids=range(len(INJECTIONS)))
def test_expressions_are_formulas_and_nothing_else(text):
    with pytest.raises(InputError):
        Expression(text)


def test_what_the_device_compiles_is_written_from_the_list_of_operations():
    from clvoro.sizing import generate_code

    text = generate_code(Expression("  0.1+\tfabs( x )*\n2e-1 < y ? min(x,y) : 3 "), BOX).prelude
    body = text.split('#line 1 "size_at"')[1]
    known = {"REAL", "size_at", "const", "x", "__global", "data", "return", "fabs", "size_min"}
    names = set(re.findall(r"[A-Za-z_]\w*", body)) - known
    assert all(re.fullmatch(r"s\d+|e|e\d+", name) for name in names), names


CASES = {
    "not text": b"\xff\xfe\x00case",
    "cut off": b"[domain]\nlower = [0, ",
    "deep": b"x = " + b"[" * 100_000,
    "nested sizes": b"[domain]\nlower=[0,0]\nupper=[1,1]\n[size]\nkind='scale'\nfactor=2.0\nfield="
    + b"{kind='scale',factor=2.0,field=" * 3000
    + b"1.0"
    + b"}" * 3000,
    "path": b"[domain]\nlower=[0,0]\nupper=[1,1]\n[size]\nkind='raster'\nfile='/dev/zero'\n",
    "huge number": b"[domain]\nlower=[0,0]\nupper=[1e400,1]\n[size]\nkind='constant'\nvalue=1\n",
    "huge integer": b"[domain]\nlower=[0,0]\nupper=[" + b"9" * 400 + b",1]\n[size]\nkind='constant'\nvalue=1\n",
    "null": b"[domain]\nlower=[0,0]\nupper=[1,1]\n[size]\nkind='raster'\nfile='a\\u0000b'\n",
}


@pytest.mark.parametrize("name", list(CASES))
def test_cases_that_are_none_are_refused(tmp_path, name):
    (tmp_path / "c.toml").write_bytes(CASES[name])
    with pytest.raises(InputError):
        load_case(tmp_path / "c.toml").size_field()


PLAIN = b"[domain]\nlower=[0,0]\nupper=[1,1]\n[size]\nkind='constant'\nvalue=0.3\n"


@pytest.mark.parametrize("part", ["a", "'a'", '"a"', '"a\\""', "a ", " a", "a\t"])
@pytest.mark.parametrize("line", ["{}=1", "[{}]", "[[{}]]", "x={{{}=1}}"])
def test_keys_of_very_many_parts_are_refused(tmp_path, part, line):
    """The parser would make tables of all text before each part."""
    path = tmp_path / "c.toml"
    path.write_text("\n\n" + line.format(".".join([part] * 50_000)))
    with pytest.raises(InputError, match=r"c\.toml: .* more than 16 parts \(at line 3"):
        load_case(path)


def test_the_search_for_long_keys_goes_over_the_text_once():
    """A search from each of so many characters back to the first would take minutes."""
    for piece in ("a", "a.", "a ", '"', "'", "\"'", ". ", '"\\', "a.'", "\\", '"""\\"', "'''a", '"a"', "a#"):
        text = piece * ((1 << 18) // len(piece))
        began = time.process_time()
        with pytest.raises(ValueError, match=r"\(at "):
            read_toml(text)
        assert time.process_time() - began < 5, piece


def test_keys_of_many_parts_and_numbers_are_read():
    assert read_toml(".".join("a" * 16) + "=1")
    assert read_toml("a=[" + "1.5,0.25, " * 100 + "]")
    dots = ".".join("a" * 99)
    for text in (
        f"b='{dots}'",
        f'b="\\"{dots}"',
        f"b=1 # '{dots}",
        f'b="""{dots}\n"" {dots}\\""""',
        f"b='''\n{dots}'''",
    ):
        assert read_toml(text)["b"]
    for ends in ('"""c""""', '"""c"""""', "'''c''''", "'''c'''''"):  # with quotes before the last ones
        with pytest.raises(ValueError, match="parts"):
            read_toml(f"x=[{{b={ends}, {dots}=1}}]")
    with pytest.raises(ValueError, match="parts"):  # whatever stands before it
        read_toml(f"b='\"'\nc=\"'\"\n#\"\nd='''\"'''\n{dots}=1")
    with pytest.raises(ValueError, match="longer"):
        read_toml("#" * (LONGEST + 1))


@pytest.mark.parametrize(
    "name", ["/tmp/x", "../x", "..", ".", "a/b", "a\\b", "a/", "C:x", "a\0b", "a\nb", "\x1b[31m", "\u00e4" * 101, ""]
)
def test_names_of_cases_that_lead_elsewhere_are_refused(tmp_path, name):
    path = tmp_path / "c.toml"
    path.write_bytes(f"name = {json.dumps(name)}\n".encode() + PLAIN)
    with pytest.raises(InputError, match=r"c\.toml: name is "):
        load_case(path)


@pytest.mark.parametrize("file", ["...toml", "..toml"])
def test_files_of_cases_whose_names_lead_elsewhere_are_refused(tmp_path, file):
    (tmp_path / file).write_bytes(PLAIN)
    with pytest.raises(InputError, match="name is "):
        load_case(tmp_path / file)


@pytest.mark.parametrize("name", ["a b", "...x", ".x", "\u00e4: 1"])
def test_names_of_cases_are_folders_in_out(tmp_path, name):
    (tmp_path / "c.toml").write_bytes(f"name = {json.dumps(name)}\n".encode() + PLAIN)
    assert load_case(tmp_path / "c.toml").name == name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("GEOMETRYCOLLECTION(" * 100_000, "more than 8 nested parentheses"),
        ("POLYGON (" + "(" * 9 + ")" * 9 + ")", "more than 8 nested parentheses"),
        ("POLYGON ((nan 0, 1 0, 1 1, nan 0))", "finite numbers"),
        ("POLYGON ((0 0, 1 0, 1 nan, 0 0))", "vertex 2 at .* expected finite numbers"),
        ("POLYGON ((0 0, 1e400 0, 1 1, 0 0))", "vertex 1 at .* expected finite numbers"),
        ("x" * 100_000, "not well-known text"),
        ("POLYGON ((0 0\0, 1 0, 1 1, 0 0))", "not well-known text"),
        ("POLYGON ((0 0, 1 0, 1 1, \udc80 0))", "not well-known text"),
    ],
    ids=["deep", "deeper", "nan", "nan within", "huge", "long", "zero byte", "no text"],
)
def test_well_known_text_that_is_none_is_refused(text, message):
    """Without a warning, and before GEOS overflows the stack."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=message) as refused:
            clvoro.Polygon.from_wkt(text)
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize("bad", [True, False, "1"])
def test_geojson_with_positions_that_are_no_numbers_is_refused(bad):
    ring = [[0, 0], [1, 0], [1, bad], [0, 0]]
    with pytest.raises(InputError, match="at 2 of a ring, expected numbers"):
        clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": [ring]})


@pytest.mark.parametrize(
    "other",
    [[(1, 1), (2, 1), (2, 2)], [(2, 1), (2, 2), (1, 1), (2, 1)], [(2, 2), (2, 1), (1, 1)], [(2, 1), (1, 1), (2, 2)]],
)
def test_equal_rings_are_refused_before_all_are_looked_at(monkeypatch, other):
    square, hole = [(0, 0), (9, 0), (9, 9), (0, 9)], [(1, 1), (2, 1), (2, 2)]
    looked = []
    monkeypatch.setattr(rings, "_cleaned", lambda *a, clean=rings._cleaned: looked.append(a) or clean(*a))
    with pytest.raises(InputError, match="Polygon's hole-2 repeats hole-1; leave"):
        clvoro.Polygon(square, [hole, *[other] * 10_000])
    assert len(looked) == 3
    with pytest.raises(InputError, match="outer-2 repeats outer-1"):
        clvoro.Polygon.from_pieces([[hole], [other]])


def test_errors_name_few_of_many_rings_at_one_place():
    square = [(0, 0), (9, 0), (9, 9), (0, 9)]
    holes = [[(1, 1), (2, 1), (2, 2 + 0.1 * k)] for k in range(50)]
    with pytest.raises(InputError, match=r"of hole-1 and .* more rings; ") as refused:
        clvoro.Polygon(square, holes)
    assert len(str(refused.value)) < 500


def test_well_known_text_may_have_many_parentheses_beside_each_other():
    squares = ",".join(f"(({k} 0,{k}.5 0,{k}.5 1,{k} 0))" for k in range(40))
    assert clvoro.Polygon.from_wkt(f"MULTIPOLYGON ({squares})").n_pieces == 40


FORMATS = [
    "m.npz",
    "m.vtu",
    "a.npy",
    "state",
    "c.toml",
    "g.geojson",
    "w.wkt",
    "s.stl",
    "ascii.stl",
    "s.obj",
    "s.off",
    "s.ply",
]


@pytest.fixture(scope="module")
def valid(ctx):
    return files.valid_files(clvoro.Adapter(ctx))


def test_valid_files_of_all_formats_are_read(valid, tmp_path):
    assert sorted(valid) == sorted(FORMATS)
    for name, data in valid.items():
        (tmp_path / name).write_bytes(data)
        files.read(tmp_path / name)


def read_damaged(folder, name, data, seeds):
    """Read `data` damaged in one way for each of `seeds`; return how many were read and how many refused."""
    ends = {"read": 0, "refused": 0}
    (folder / "right").write_bytes(data)
    for seed in seeds:
        path = folder / name
        path.write_bytes(files.damaged(np.random.default_rng(seed), data))
        began = time.monotonic()
        try:
            found = files.read(path)
        except InputError:
            ends["refused"] += 1
        else:
            ends["read"] += 1
            if isinstance(found, Saved):  # the state of a run
                assert files.same(found, Saved(folder / "right")), seed
        assert time.monotonic() - began < 20, seed
    return ends


def test_surfaces_with_bytes_that_are_no_text(valid, tmp_path):
    (tmp_path / "s.off").write_bytes(valid["s.off"].replace(b"0.0", b"\xff\xfe\x80", 1))
    with pytest.raises(InputError, match=r"s\.off' cannot be read as OFF.*export it again"):
        files.read(tmp_path / "s.off")


def test_coordinates_that_are_no_numbers_are_refused_without_a_warning(valid, tmp_path):
    data = bytearray(valid["s.stl"])
    data[84 + 12 : 84 + 16] = struct.pack("<f", np.inf)
    (tmp_path / "s.stl").write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match="finite"):
            files.read(tmp_path / "s.stl")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files")
@pytest.mark.parametrize("name", [*FORMATS, "case of geojson", "case of wkt", "case of raster"])
def test_pipes_and_devices_are_refused(tmp_path, name):
    """No reader waits for a writer, or reads an endless file."""
    for made in (os.mkfifo, lambda path: os.symlink("/dev/zero", path), os.mkdir):
        folder = tmp_path / made.__name__.strip("<>")
        folder.mkdir()
        path = folder / name
        if name.startswith("case"):
            (folder / "c.toml").write_bytes(CASES_OF[name])
            made(folder / re.search(rb"'(x\.\w+)'", CASES_OF[name])[1].decode())
            path = folder / "c.toml"
        else:
            made(path)
        with pytest.raises(InputError, match=r"not a regular file|[Dd]irectory"):
            files.read(path)


CASES_OF = {
    "case of geojson": PLAIN.replace(b"lower=[0,0]\nupper=[1,1]", b"polygon = 'x.geojson'"),
    "case of wkt": PLAIN.replace(b"lower=[0,0]\nupper=[1,1]", b"polygon = 'x.wkt'"),
    "case of raster": PLAIN.replace(b"'constant'\nvalue=0.3", b"'raster'\nfile = 'x.npy'"),
}


def test_texts_have_an_end(tmp_path):
    path = tmp_path / "c.toml"
    path.write_bytes(PLAIN + b"#" * LONGEST)
    with pytest.raises(InputError, match="longer than"):
        load_case(path)
    with open(tmp_path / "g.geojson", "wb") as file:  # of holes
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="longer than"):
        clvoro.Polygon.from_geojson(tmp_path / "g.geojson")
    (tmp_path / "short").write_bytes(b"\xef\xbb\xbfab")
    assert read_text(tmp_path / "short", 5) == "ab"
    with pytest.raises(OSError, match="longer than 4"):
        read_text(tmp_path / "short", 4)
    if Path("/proc/self/status").exists():  # which says that it is empty
        assert "Pid" in read_text("/proc/self/status", 1 << 20)
        with pytest.raises(OSError, match="longer than 40"):
            read_text("/proc/self/status", 40)


def test_paths_with_zero_bytes_are_refused():
    with pytest.raises(InputError, match="zero bytes"):
        clvoro.Polygon.from_geojson("a\0b.geojson")


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_refused_or_read(valid, tmp_path, name):
    assert read_damaged(tmp_path, name, valid[name], range(40))["refused"] > 5


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_thousand_damaged_files_are_refused_or_read(valid, tmp_path, name):
    assert read_damaged(tmp_path, name, valid[name], range(1000, 2000))["refused"] > 300


@pytest.mark.sparse(1)
@pytest.mark.parametrize("count", [60, pytest.param(2000, marks=pytest.mark.slow)], ids=["some", "many"])
@pytest.mark.parametrize("name", ["state", "m.npz"])
def test_a_changed_bit_is_found_or_harmless(valid, tmp_path, name, count):
    """Checksums cover every bit of the data: a file that can be read after a change has the same data."""
    data, rng = valid[name], np.random.default_rng(17)
    (tmp_path / "right").write_bytes(data)
    read = read_state if name == "state" else read_result
    right, found = read(tmp_path / "right"), 0
    for _ in range(count):
        changed = bytearray(data)
        changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        (tmp_path / name).write_bytes(changed)
        try:
            got = read(tmp_path / name)
        except InputError:
            found += 1
        else:
            assert got == right
    assert found > 0.8 * count


def read_state(path):
    return {name: array.tobytes() for name, array in Saved(path).arrays.items()}


def read_result(path):
    result = clvoro.load(path)
    arrays = (result.points, result.target_size, result.size_error, result.quality, result.history)
    of_diagram = {name: getattr(result.diagram, name).tobytes() for name in result.diagram._arrays}
    return [*(a.tobytes() for a in arrays), of_diagram, result.settings]
