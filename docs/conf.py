"""Configuration of the documentation: ``python -m sphinx -W -b html docs build/docs``."""

from __future__ import annotations

import os
import re
import sys
import warnings
from pathlib import Path

from docutils.utils.math import latex2mathml

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))
# The gallery runs in the folder of each example; a first build of kernels prints nothing there.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib  # noqa: E402

import clvoro  # noqa: E402
from clvoro.geometry.domain import FOR_CALLERS, Domain  # noqa: E402

matplotlib.use("Agg")
warnings.filterwarnings("ignore", message=".*non-interactive.*")

project = "clvoro"
author = "the clvoro authors"
project_copyright = author
release = version = clvoro.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["examples", "_build"]
nitpicky = False
default_role = "code"

myst_enable_extensions = ["colon_fence", "dollarmath", "amsmath", "deflist", "smartquotes"]
myst_heading_anchors = 3

autosummary_generate = True
templates_path = ["_templates"]
autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

sphinx_gallery_conf = {
    "examples_dirs": str(DOCS / "examples"),
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "ignore_pattern": r"__init__",
    "subsection_order": [str(Path("examples") / name) for name in ("flow", "water", "moving", "space", "method")],
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "remove_config_comments": True,
    "capture_repr": (),
    "show_memory": False,
    "download_all_examples": False,
    "min_reported_time": 10_000,
    "plot_gallery": True,
    "image_srcset": ["2x"],
    "thumbnail_size": (480, 320),
    "nested_sections": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "clvoro"
html_static_path = ["_static"]
html_css_files = ["clvoro.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "clvoro"},
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 7,
    "show_toc_level": 2,
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
html_sidebars = {"index": []}


def _mathml(tex: str, *, block: bool) -> str:
    """Return a formula as MathML, which browsers show without a script or a font from elsewhere."""
    text = latex2mathml.tex2mathml(tex, as_block=block)
    return re.sub(r"<mo[^>]*>([‖∥|])</mo>", r'<mo stretchy="false">\1</mo>', text)


def _inline_math(translator, node):
    from docutils import nodes

    translator.body.append(_mathml(node.astext(), block=False))
    raise nodes.SkipNode


def _block_math(translator, node):
    from docutils import nodes

    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(f'<div class="formula">{number}{_mathml(node.astext(), block=True)}</div>')
    raise nodes.SkipNode


def _escape_bars(app, what, name, obj, options, lines):
    """Let ``|e|`` in a docstring stand for itself: reStructuredText would look for a substitution."""
    literal = None  # indentation of the line that opens a literal block
    for k, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if literal is not None and line.strip() and indent <= literal:
            literal = None
        if literal is None:
            lines[k] = re.sub(r"(?<![`\w])\|([^|\s`][^|`]*)\|", r"\|\1\|", line)
            if line.rstrip().endswith("::"):
                literal = indent


_OF_DOMAINS = {name for kind in Domain.__mro__ for name in vars(kind)} - FOR_CALLERS
_INTERNAL = """check_dim default_color framed_by items map_parts projected watched Curve.nodes Diagram.demand_cells
Diagram.demand_voronoi Diagram.has_moved_vertices Diagram.with_arrays Faces.compact Faces.far Faces.images Faces.near
Faces.side_ends Faces.take_faces Faces.take_vectors Faces.with_half_faces Measures.line Polygon.crossings
Polygon.digest Polygon.edge_ends Polygon.edges_within Polygon.find_edges Polygon.geometry Polygon.is_slit
Run.call_parts Run.conclude Run.fixed_count Run.note Run.record Solid.clearance Solid.closest Solid.corner_kinds
Solid.corner_normals Solid.curvature Solid.feet_on_patch Solid.shell_volumes Solid.shells Solid.side_kinds
Solid.widths SolverMeasures.bad_tetrahedra_of SolverMeasures.cells SolverMeasures.concave_pairs
SolverMeasures.coupled SolverMeasures.edge_of_corner SolverMeasures.edge_spans SolverMeasures.edges
SolverMeasures.face_cells SolverMeasures.geometry SolverMeasures.line Surface.areas Surface.check Surface.columns
Surface.crossings Surface.distance2 Surface.open_sides Surface.packed Surface.places Surface.require_closed
Surface.rows Surface.tree""".split()


def _leave_out(app, what, name, obj, skip, options):
    """Leave out of the pages of classes the members that only the package itself uses."""
    function = getattr(obj, "fget", None) or getattr(obj, "func", None) or obj
    whole = getattr(function, "__qualname__", name)
    return True if name in _OF_DOMAINS or name in _INTERNAL or whole in _INTERNAL else None


def setup(app):
    """Register the renderer of formulas, and the changes of docstrings and members."""
    app.connect("autodoc-process-docstring", _escape_bars, priority=100)
    app.connect("autodoc-skip-member", _leave_out)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))


html_math_renderer = "mathml"
