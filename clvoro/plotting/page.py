"""The report: one HTML page with embedded pictures, and the pictures as files beside it."""

from __future__ import annotations

import base64
import html
import warnings
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from ..errors import MissingLibraryError, MissingPicturesWarning
from ..io.atomic import atomic_file, writing
from ..mesh.results import Result, beside_boundary, summary, thickness_in_words
from .pictures import draw, pictures_of, render

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1c1c; background: #fff; max-width: 60rem;
       margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
p.what { color: #555; margin-top: .2rem; }
dl { display: flex; flex-wrap: wrap; gap: .7rem; }
dl div { flex: 1 1 6rem; border: 1px solid #ddd; border-radius: .4rem; padding: .5rem .8rem; }
dt { color: #555; font-size: .8rem; } dd { margin: 0; font-size: 1.25rem;
     font-variant-numeric: tabular-nums; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
th, td { text-align: right; padding: .3rem .6rem; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left; }
table.measures { width: auto; } table.measures td:last-child, table.measures th:last-child { text-align: right; }
thead th { color: #555; font-weight: 600; font-size: .85rem; } tr.main td { font-weight: 600; }
th { white-space: nowrap; }
figure { margin: 1.5rem 0; break-inside: avoid; } img { max-width: 100%; height: auto; }
figcaption { color: #444; font-size: .9rem; }
pre { background: #f6f6f6; padding: .8rem 1rem; overflow-x: auto; font-size: .85rem; }
"""


def write_report(
    results: Result | Mapping[str, Result],
    folder: str | PathLike[str],
    *,
    initial: Result | None = None,
    size: Callable[[np.ndarray], np.ndarray] | None = None,
    title: str = "Voronoi mesh",
    case: str = "",
    facts: Mapping[str, str] | None = None,
    formats: Sequence[str] = ("png",),
    dpi: int = 170,
    tell: Callable[[str], object] | None = None,
) -> list[Path]:
    """Write `report.html` and its pictures into `folder`.

    Parameters
    ----------
    results : Result or mapping
        One result, or several by the method's name from one start; the last is the main one.
    folder : path
        Created if needed; the pictures go into its subfolder `pictures/`.
    initial : Result, optional
        The mesh before the first step.
    size : callable, optional
        The size field h(points (n, d)), for its picture.
    title : str
    case : str
        Text of the case file, shown at the end.
    facts : mapping, optional
        Further facts for the head of the page.
    formats : sequence of {"png", "pdf", "svg"}
        Files per picture; the page itself always holds PNG.
    dpi : int
    tell : callable, optional
        Called with a line of text before each picture is drawn.

    Returns
    -------
    list of Path
        The files written, the page first.

    Raises
    ------
    OutputError, MemoryError, or whatever Matplotlib raises
        The first error, after everything else has been written.

    Warns
    -----
    MissingPicturesWarning
        If pictures are left out, because PyVista (for meshes in 3D) or Cartopy (on spheres) is not installed.
    """
    if isinstance(results, Result):
        method = results.settings.get("method") or "result"
        results = {str(method): results}
    target = Path(folder)
    with writing(target / "pictures"):
        (target / "pictures").mkdir(parents=True, exist_ok=True)
    written, figures, failed, missing = [], [], None, ""
    pictures = pictures_of(results, initial, size)
    for number, picture in enumerate(pictures, 1):
        name, caption, _ = picture
        if tell is not None:
            tell(f"picture {number} of {len(pictures)}, {name}")
        try:
            figure = draw(picture)
            png = render(figure, "png", dpi)
            figures.append((caption, png))
            for kind in formats:
                path = target / "pictures" / f"{name}.{kind}"
                _write(path, png if kind == "png" else render(figure, kind, dpi))
                written.append(path)
        except MissingLibraryError as error:
            missing = str(error)
        except Exception as error:  # raised below, after the other pictures
            failed = failed or error
    page = target / "report.html"
    _write(page, _page(results, title, case, facts or {}, figures, missing).encode())
    if missing:
        warnings.warn(f"the report has no pictures of the mesh: {missing}", MissingPicturesWarning, stacklevel=2)
    if failed is not None:
        raise failed
    return [page, *written]


def _write(path: Path, content: bytes) -> None:
    with atomic_file(path) as file:
        file.write(content)


def _page(
    results: Mapping[str, Result],
    title: str,
    case: str,
    facts: Mapping[str, str],
    figures: Sequence[tuple[str, bytes]],
    missing: str,
) -> str:
    name, main = list(results.items())[-1]
    numbers = summary(main)
    head = {
        "cells": f"{numbers['cells']:,}".replace(",", " "),
        "mean error |e|": f"{numbers['mean_error']:.4f}",
        "largest |e|": f"{numbers['max_error']:.3f}",
        "mean quality Q": f"{numbers['mean_quality']:.4f}",
        "lowest Q": f"{numbers['min_quality']:.3f}",
        "steps": str(numbers["steps"]),
        "time": f"{numbers['seconds']:.2f} s",
    }
    cards = "".join(f"<div><dt>{_safe(k)}</dt><dd>{_safe(v)}</dd></div>" for k, v in head.items())
    if main.settings.get("widths"):
        facts = {**facts, "layers": main.settings["widths"]}
    if main.scaling:
        facts = {**facts, "number of cells": main.scaling}
    if numbers["trade"]:
        facts = {**facts, "sizes and shape": numbers["trade"]}
    if numbers.get("thickness"):
        words = [f"{numbers['layer_cells']:,} cells", *thickness_in_words(numbers["thickness"])]
        facts = {**facts, "layers": "; ".join(words)}
    if numbers.get("left_out_parts"):
        facts = {**facts, "mesh for solvers": str(main.left_out)}
    words = "; ".join([f"method {name}", *(f"{k} {v}" for k, v in facts.items())])
    parts = [
        f"<h1>{_safe(title)}</h1><p class=what>{_safe(words)}</p><dl>{cards}</dl>",
        f"<h2>Runs</h2>{_runs(results, name)}" if len(results) > 1 else f"<p>Stopped: {_safe(main.stop_reason)}.</p>",
        f"<h2>Cells on the boundary</h2>{apart}" if (apart := _apart(results, name)) else "",
        f"<h2>Measures for finite volumes</h2>{_measures(name, main)}",
        f"<h2>Pictures</h2><p>{_safe(missing)}</p>" if missing else "<h2>Pictures</h2>",
    ]
    for caption, png in figures:
        data = base64.b64encode(png).decode()
        parts.append(
            f'<figure><img alt="{_safe(caption)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_safe(caption)}</figcaption></figure>"
        )
    if case:
        parts.append(
            "<h2>To repeat it</h2><p>This is <code>case.toml</code> beside this page: "
            f"call <code>clvoro run case.toml</code>.</p><pre>{_safe(case)}</pre>"
        )
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{_safe(title)}</title><style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _measures(name: str, result: Result) -> str:
    """Return the table of `Result.measures`, with explanations."""
    s = result.measures.summary()
    rows = [
        ("faces per cell", f"{s['mean_faces']:.4g}", ""),
        ("skewness", f"{s['mean_skewness']:.4g}", f"{s['max_skewness']:.3g}"),
        ("angle of centroids [°]", f"{s['mean_centroid_angle']:.4g}", f"{s['max_centroid_angle']:.3g}"),
        ("smallest over largest face of a cell", f"{s['mean_face_ratio']:.4g}", f"{s['min_face_ratio']:.3g}"),
        ("volumes of neighbors, larger over smaller", f"{s['mean_volume_ratio']:.4g}", f"{s['max_volume_ratio']:.3g}"),
    ]
    return (
        f"{_table((name, 'mean', 'worst'), rows)}<p class=what>With the unknowns at the generators there is no "
        "non-orthogonality; the angle is what remains between a face's normal and the line from centroid to "
        "centroid. Skewness: from a face's centroid to that line of the generators, over their distance.</p>"
    )


def _apart(results: Mapping[str, Result], main: str) -> str:
    """Return the table of boundary cells, those of them at corners, and inner cells; "" where no edges cut cells."""
    rows = []
    for method, result in results.items():
        for part, s in beside_boundary(result).items():
            numbers = (f"{s['mean_error']:.4f}", f"{s['mean_quality']:.4f}", f"{s['min_quality']:.3f}")
            rows.append((method, f"{part} cells", str(s["cells"]), *(numbers if s["cells"] else ("–",) * 3)))
    return _table(("method", "", "number", "mean |e|", "mean Q", "min Q"), rows, main) if rows else ""


def _runs(results: Mapping[str, Result], main: str) -> str:
    """Return the table of the runs."""
    rows = []
    for method, result in results.items():
        s = summary(result)
        errors = (f"{s['mean_error']:.4f}", f"{s['max_error']:.3f}")
        qualities = (f"{s['mean_quality']:.4f}", f"{s['min_quality']:.3f}")
        rows.append((method, str(s["steps"]), *errors, *qualities, f"{s['seconds']:.2f}", s["stop_reason"]))
    return _table(("method", "steps", "mean |e|", "max |e|", "mean Q", "min Q", "seconds", "stopped"), rows, main, "")


def _table(names: Sequence[str], rows: Sequence[Sequence[str]], main: str = "", kind: str = " class=measures") -> str:
    """Return a table; rows that begin with `main` are set off."""
    head = "".join(f"<th>{_safe(name)}</th>" for name in names)
    body = [
        f"<tr{' class=main' if main and row[0] == main else ''}>{''.join(f'<td>{_safe(t)}</td>' for t in row)}</tr>"
        for row in rows
    ]
    return f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def _safe(text: object) -> str:
    return html.escape(str(text))
