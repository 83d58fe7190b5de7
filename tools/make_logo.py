"""
Draw the logo: the 18 segments of the telescope's mirror, colored from blue to red.

    python tools/make_logo.py

writes docs/_static/logo.svg.
"""

import math
from pathlib import Path

#: Blue, violet and red: F770W, F1500W and F2100W of the color images.
COLORS = ((37, 99, 235), (147, 51, 150), (220, 60, 30))
#: Distance of the centers of two segments, and radius of one.
PITCH, RADIUS = 20.0, 10.6


def color(share):
    """Color at a share of the way from blue to red."""
    first, second = (COLORS[0], COLORS[1]) if share < 0.5 else (COLORS[1], COLORS[2])
    part = 2 * share % 1 if share < 1 else 1.0
    return "#" + "".join(
        f"{round(a + part * (b - a)):02x}" for a, b in zip(first, second, strict=True)
    )


def segments():
    """Centers of the 18 segments: two rings about the missing one in the middle."""
    for q in range(-2, 3):
        for r in range(max(-2, -q - 2), min(2, -q + 2) + 1):
            if (q, r) != (0, 0):
                yield PITCH * math.sqrt(3) / 2 * q, PITCH * (r + q / 2)


def hexagon(x, y):
    """Corners of a segment with its flat sides up and down."""
    angles = (math.radians(60 * k) for k in range(6))
    return " ".join(
        f"{x + RADIUS * math.cos(a):.2f},{y + RADIUS * math.sin(a):.2f}" for a in angles
    )


def main():
    shapes = []
    for x, y in segments():
        share = (x + 0.35 * y) / (2 * 1.35 * 34.7) + 0.5
        shapes.append(f'<polygon points="{hexagon(x, y)}" fill="{color(min(max(share, 0), 1))}"/>')
    svg = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="-52 -52 104 104">\n'
    svg += "<title>miricigale</title>\n" + "\n".join(shapes) + "\n</svg>\n"
    path = Path(__file__).parents[1] / "docs" / "_static" / "logo.svg"
    path.write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    main()
