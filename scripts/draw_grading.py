"""Draws docs/images/grade-pose.svg and grade-path.svg: the measured values of a grade (docs/review.md)."""

import math
from collections.abc import Iterable
from pathlib import Path

IMAGES = Path(__file__).parents[1] / "docs" / "images"
DARK, MOTION, GOAL, MEASURED = "#222222", "#1f6fb4", "#2c8a3d", "#b3402a"

Point = tuple[float, float]


def line(points: Iterable[Point], color: str, more: str = "") -> str:
    """Return a line through points."""
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{text}" fill="none" stroke="{color}" stroke-width="2" {more}/>'


def text(x: float, y: float, content: str, color: str = DARK, anchor: str = "start") -> str:
    """Return a text at a point."""
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}" text-anchor="{anchor}">{content}</text>'


def arrow(start: Point, end: Point, color: str = MEASURED) -> str:
    """Return a line with a head at each end."""
    return line([start, end], color, 'marker-start="url(#head)" marker-end="url(#head)"')


def band(x: float, y: float, width: float, height: float, color: str) -> str:
    """Return a translucent rectangle."""
    size = f'width="{width:.1f}" height="{height:.1f}"'
    return f'<rect x="{x:.1f}" y="{y:.1f}" {size} fill="{color}" fill-opacity="0.15"/>'


def save(name: str, width: int, height: int, title: str, parts: list[str]) -> None:
    """Write a drawing on an opaque background, which is legible on a light and on a dark page."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'role="img" font-family="sans-serif" font-size="14">'
    )
    marker = (
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="6" markerHeight="6" '
        f'orient="auto-start-reverse"><path d="M0,0 L10,5 L0,10 z" fill="{MEASURED}"/></marker></defs>'
    )
    page = f'<rect width="{width}" height="{height}" rx="8" fill="#fafafa"/>'
    body = "\n".join([head, f"<title>{title}</title>", marker, page, *parts, "</svg>"])
    (IMAGES / name).write_text(body + "\n", encoding="utf-8")


def pose() -> None:
    """Draw the distance along the line to a pose over time: a second-order response."""
    damping, rate, hold, tolerance = 0.3, 1.0, 5.0, 0.15
    natural = rate * math.sqrt(1 - damping**2)

    def position(t: float) -> float:
        decay = math.exp(-damping * rate * t)
        return 1 - decay * (math.cos(natural * t) + damping * rate / natural * math.sin(natural * t))

    def at(t: float, s: float) -> Point:
        return 90 + 26 * t, 260 - 150 * s

    times = [index / 10 for index in range(171)]
    settled = max(t for t in times if abs(position(t) - 1) > tolerance)
    peak = math.pi / natural
    (left, zero), (right, goal) = at(0, 0), at(17, 1)
    low, high = at(0, 1 - tolerance)[1], at(0, 1 + tolerance)[1]
    begin, reached, bottom = at(settled, 0)[0], at(settled + hold, 0)[0], zero + 34
    parts = [
        band(left, high, right - left, low - high, GOAL),
        line([(left, goal), (right, goal)], GOAL),
        text(left - 8, goal + 5, "pose", GOAL, "end"),
        text(right + 8, high + 6, "+ tolerance", GOAL),
        text(right + 8, low + 6, "− tolerance", GOAL),
        line([(left, 40), (left, zero), (right, zero)], DARK),
        text(left - 8, zero + 5, "start", DARK, "end"),
        text(left + 8, 40, "distance from the start, along the straight line to the pose"),
        text(right + 8, zero + 5, "time"),
        line([at(t, position(t)) for t in times], MOTION),
        arrow(at(peak, 1), at(peak, position(peak))),
        text(at(peak, 0)[0] + 12, at(0, position(peak))[1] + 4, "overshoot", MEASURED),
        *(
            line([(x, goal), (x, bottom + 6)], DARK, 'stroke-dasharray="4 4" stroke-opacity="0.6"')
            for x in (begin, reached)
        ),
        arrow((left, bottom), (begin, bottom)),
        text((left + begin) / 2, bottom + 20, "settling time", MEASURED, "middle"),
        arrow((begin, bottom), (reached, bottom)),
        text((begin + reached) / 2, bottom + 20, "hold_s", MEASURED, "middle"),
        text(reached + 6, zero - 10, "reached"),
    ]
    save("grade-pose.svg", 640, 325, "Overshoot, settling time and hold time of a pose", parts)


def path() -> None:
    """Draw a path with the tool's track, and the progress on a path that passes a stretch twice."""
    corner = [(50.0, 220.0), (50.0, 90.0), (270.0, 90.0)]
    track = [
        (50, 220),
        (60, 190),
        (64, 150),
        (52, 115),
        (64, 98),
        (100, 78),
        (140, 72),
        (190, 96),
        (230, 94),
        (270, 90),
    ]
    wide = 'stroke-opacity="0.15" stroke-linejoin="round" style="stroke-width:36"'
    parts = [
        line(corner, GOAL, wide),
        line(corner, GOAL),
        line(track, MOTION, 'stroke-linejoin="round"'),
        arrow((140, 90), (140, 72)),
        text(140, 58, "tracking error", MEASURED, "middle"),
        text(46, 240, "first point"),
        text(250, 125, "last point"),
        text(85, 150, "± tolerance_mm", GOAL),
        text(85, 172, "the tool", MOTION),
    ]
    left, right, zero, full = 400, 640, 220, 90
    middle = (zero + full) / 2
    steps = [(left, zero), (480, middle + 12), (495, middle + 22), (515, middle), (right - 40, full), (right, full)]
    best = [(left, zero), (480, middle + 12), (509, middle + 12), (515, middle), (right - 40, full), (right, full)]
    parts += [
        line([(left, 60), (left, zero), (right, zero)], DARK),
        text(left, 50, "position along the path A-B-A"),
        text(right + 8, zero + 5, "time"),
        *(text(left - 8, y + 5, name, DARK, "end") for y, name in ((zero, "A"), (middle, "B"), (full, "A"))),
        *(line([(left, y), (right, y)], DARK, 'stroke-opacity="0.2"') for y in (middle, full)),
        line(best, MEASURED, 'stroke-dasharray="5 4"'),
        line(steps, MOTION),
        text(520, middle + 28, "progress: the covered", MEASURED),
        text(520, middle + 46, "share, never less", MEASURED),
        text(right + 8, full + 5, "100 %", MEASURED),
    ]
    save("grade-path.svg", 700, 260, "Tracking error and progress on a path", parts)


def main() -> None:
    """Write both drawings."""
    pose()
    path()


if __name__ == "__main__":
    main()
