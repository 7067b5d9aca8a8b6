"""Draw the picture of the packages: ``python docs/developer/packages.py`` writes `packages.svg`."""

from pathlib import Path

WIDTH, ROW, GAP = 760, 62, 14
ROWS = [
    [("cli", "the command, cases"), ("adapter.py", "the entry: adapt, voronoi, Adapter")],
    [("foam", "cases of OpenFOAM follow a solution"), ("earth", "spheres, oceans, C grids")],
    [
        ("plotting", "pictures, report"),
        ("remapping", "transfer between meshes"),
        ("adaptation", "the loop, the methods"),
    ],
    [("tessellation", "the diagram on the device"), ("solvers", "Poisson, projection")],
    [("sizing", "size fields"), ("io", "files")],
    [("finite_volumes", "what solvers read")],
    [("mesh", "Diagram, Result, checks")],
    [("geometry", "domains, shapes, layers")],
    [("opencl", "devices, kernels, arrays")],
]
FILLS = ["#f8fafd", "#f2f6fb", "#e8eef7", "#dbe7f5", "#cfe0f2", "#c3d9ef", "#b7d2ec", "#abcbe9", "#9fc4e6"]


def main() -> None:
    """Write the picture beside this file."""
    height = len(ROWS) * (ROW + GAP) + GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH + 60} {height}" '
        'font-family="DejaVu Sans, Helvetica, Arial, sans-serif" text-anchor="middle">'
    ]
    for r, row in enumerate(ROWS):
        width = (WIDTH - GAP * (len(row) + 1)) / len(row)
        y = GAP + r * (ROW + GAP)
        for c, (name, what) in enumerate(row):
            x = GAP + c * (width + GAP)
            middle = x + width / 2
            parts.append(
                f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{ROW}" rx="6" '
                f'fill="{FILLS[r]}" stroke="#36597f"/>'
                f'<text x="{middle:.0f}" y="{y + 27}" font-size="18" font-weight="bold" '
                f'fill="#14283f">{name}</text>'
                f'<text x="{middle:.0f}" y="{y + 48}" font-size="14" fill="#14283f">{what}</text>'
            )
    x, top, bottom = WIDTH + 22, GAP + 6, height - GAP - 8
    parts.append(
        f'<path d="M{x} {top} V{bottom} m-7 -12 l7 12 l7 -12" fill="none" stroke="#36597f" '
        f'stroke-width="2"/><text transform="translate({x + 22} {height / 2:.0f}) rotate(90)" '
        'font-size="15" fill="#36597f">imports</text></svg>'
    )
    Path(__file__).with_suffix(".svg").write_text("\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
