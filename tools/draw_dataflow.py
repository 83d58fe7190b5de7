"""
Draw ``docs/_static/dataflow.svg``: the seven classes and what passes between them.

All text stands on filled shapes, so that the picture is legible on light and dark pages::

    python tools/draw_dataflow.py
"""

from pathlib import Path

OUT = Path(__file__).parents[1] / "docs" / "_static" / "dataflow.svg"
WIDTH, HEIGHT = 1046, 430
BOX, TALL = (168, 62), {1: 110, 2: 320}
COLUMNS = (10, 296, 582, 868)
BLUE, PALE, INK, LINE = "#2a6f97", "#e4e9ee", "#1b2733", "#8a939c"


def box(column, row, name, text, *, fill=BLUE, ink="white"):
    """Draw a class with its name and what it does."""
    x, y = COLUMNS[column], TALL[row] - BOX[1] / 2
    yield f'<rect x="{x}" y="{y}" width="{BOX[0]}" height="{BOX[1]}" rx="8" fill="{fill}"/>'
    style = 'text-anchor="middle"'
    middle = x + BOX[0] / 2
    yield f'<text x="{middle}" y="{y + 27}" {style} fill="{ink}" class="name">{name}</text>'
    yield f'<text x="{middle}" y="{y + 47}" {style} fill="{ink}">{text}</text>'


def pill(x, y, *lines, width=112):
    """Draw a value that is passed on, with its type and unit."""
    height = 10 + 16 * len(lines)
    yield (
        f'<rect x="{x - width / 2}" y="{y - height / 2}" width="{width}" height="{height}" '
        f'rx="{min(height / 2, 16)}" fill="{PALE}"/>'
    )
    for k, line in enumerate(lines):
        at = y - height / 2 + 18 + 16 * k
        yield f'<text x="{x}" y="{at}" text-anchor="middle" fill="{INK}">{line}</text>'


def arrow(*points):
    """Draw a line with a head at its end."""
    path = " L".join(f"{x} {y}" for x, y in points)
    yield f'<path d="M{path}" fill="none" stroke="{LINE}" stroke-width="2.5" marker-end="url(#h)"/>'


def draw():
    """Return the picture as text."""
    left = [x - 2 for x in COLUMNS]
    right = [x + BOX[0] + 2 for x in COLUMNS]
    middle = [x + BOX[0] / 2 for x in COLUMNS]
    one, two, half = TALL[1], TALL[2], BOX[1] / 2
    parts = [
        # arrows first: pills lie on them
        arrow((right[0], one), (left[1] - 6, one)),
        arrow((right[1], one), (left[2] - 6, one)),
        arrow((right[2], one), (left[3] - 6, one)),
        arrow((middle[3], one + half), (middle[3], two - half - 8)),
        arrow((left[3], two), (right[2] + 6, two)),
        arrow((left[2], two), (right[1] + 6, two)),
        arrow((left[1], two), (right[0] + 6, two)),
        arrow((middle[1], one + half), (middle[1], two - half - 8)),
        arrow((middle[2], one + half + 60), (middle[2], two - half - 8)),
        arrow((middle[1], 40), (middle[1], one - half - 8)),
        arrow((middle[2], 40), (middle[2], one - half - 8)),
        arrow((middle[3], 40), (middle[3], one - half - 8)),
        arrow((middle[0], 396), (middle[0], two + half + 8)),
        arrow((middle[1], 396), (middle[1], two + half + 8)),
        box(0, 1, "Filter", "passbands"),
        box(1, 1, "SEDModel", "spectra, fluxes"),
        box(2, 1, "Scene", "catalog on the sky"),
        box(3, 1, "Detector", "effects in order"),
        box(3, 2, "Reducer", "ramps to mosaics"),
        box(2, 2, "ForcedPhotometer", "all sources at once"),
        box(1, 2, "BayesFitter", "posteriors"),
        box(0, 2, "evaluation", "results, truth", fill=PALE, ink=INK),
        pill(middle[1], 28, "parameters", width=110),
        pill(middle[2], 28, "catalog, PSF", width=120),
        pill(middle[3], 28, "Exposure", width=110),
        pill((right[0] + left[1]) / 2 - 4, one, "FilterSet", "µm", width=90),
        pill((right[1] + left[2]) / 2 - 4, one, "QTable", "µJy", width=80),
        pill((right[2] + left[3]) / 2 - 4, one, "CCDData", "MJy/sr", width=84),
        pill(middle[3], (one + two) / 2, "Ramp", "DN", width=90),
        pill((right[2] + left[3]) / 2 + 4, two, "CCDData", "MJy/sr", width=84),
        pill((right[1] + left[2]) / 2 + 4, two, "QTable", "µJy", width=80),
        pill((right[0] + left[1]) / 2 + 4, two, "FitResults", width=90),
        pill(middle[1], (one + two) / 2, "ModelGrid", "µJy at 1 Msun", width=120),
        pill(middle[2], (one + two) / 2, "high-resolution image,", "MatchingKernel", width=172),
        pill(middle[1], 408, "other bands, ErrorModel", width=190),
        pill(middle[0], 408, "true values", width=110),
    ]
    body = "\n".join(line for part in parts for line in part)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">
<title>The seven classes and what passes between them</title>
<style>text {{ font: 15px sans-serif }} .name {{ font: bold 16px monospace }}</style>
<defs><marker id="h" viewBox="0 0 10 10" refX="4" refY="5" markerWidth="5" markerHeight="5"
orient="auto"><path d="M0 0 L10 5 L0 10 z" fill="{LINE}"/></marker></defs>
{body}
</svg>
"""


if __name__ == "__main__":
    OUT.write_text(draw(), encoding="utf-8")
