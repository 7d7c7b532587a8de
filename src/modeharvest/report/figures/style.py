"""Style of all figures: colours, fonts, and conversion to SVG that adopts the page's colours.

Figures are SVG elements of the page: fields are raster images, labels are text. Two placeholder
colours are replaced by the page's text colours, so that figures suit light and dark pages.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import RendererSVG
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from PIL import Image

from modeharvest.util.arrays import FloatArray

INK, MUTED = "#010204", "#010305"
"""Placeholders for the page's colours of text and of secondary text."""
BLUE, RED, GREEN, GOLD = "#3987e5", "#e0603f", "#2a9d74", "#d99a1f"
"""Colours of curves, of medium lightness, so that they are visible on light and dark pages."""
COLOURS = (BLUE, RED, GREEN, GOLD)
"""Colours of several curves in one figure, in this order."""
EDGE = "#70757d"
DPI = 260
"""Resolution of raster images [px/in]; a figure of 2.35 in is 611 px wide."""

QUALITY = 90
"""WebP quality of raster images, out of 100."""

_RC: dict[Any, Any] = {  # matplotlib's type of the names differs between versions
    "svg.fonttype": "none",
    "svg.hashsalt": "modeharvest",
    "font.size": 8.0,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "axes.linewidth": 0.6,
    "axes.titley": 1.0,  # by default all ticks are measured to place the title, which is slow
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
}


@contextmanager
def style() -> Iterator[None]:
    """Use the report's style in a ``with`` block; matplotlib's settings are restored after it."""
    with mpl.rc_context(_RC):
        yield


def figure(width: float, height: float) -> Figure:
    """Make an empty figure (width, height [in]) that is not registered with pyplot."""
    made = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(made)
    return made


def _oklch_to_srgb(L: FloatArray, C: FloatArray, hue: float) -> FloatArray:
    """(n, 3) sRGB of lightness L (n,), chroma C (n,) and hue [deg] (B. Ottosson's Oklab, 2020)."""
    to_roots = np.array([[0.3963377774, 0.2158037573], [-0.1055613458, -0.0638541728],
                         [-0.0894841775, -1.2914855480]])  # fmt: skip
    to_rgb = np.array([[4.0767416621, -3.3077115913, 0.2309699292],
                       [-1.2684380046, 2.6097574011, -0.3413193965],
                       [-0.0041960863, -0.7034186147, 1.7076147010]])  # fmt: skip
    roots = L + to_roots @ np.stack([C * np.cos(np.radians(hue)), C * np.sin(np.radians(hue))])
    linear = np.clip(to_rgb @ roots**3, 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(curved.T)


def _diverging() -> Colormap:
    """Make a colour map from blue over near-white to red, with linear lightness on both sides."""
    t = np.linspace(0.0, 1.0, 128)
    lightness, chroma = 0.965 - 0.56 * t, 0.165 * np.sin(0.5 * np.pi * np.minimum(1.25 * t, 1.0))
    chroma *= 1.0 - 0.25 * np.maximum(0.0, t - 0.6) / 0.4
    cold = _oklch_to_srgb(lightness, chroma, 255.0)[::-1]
    warm = _oklch_to_srgb(lightness, chroma, 33.0)
    return LinearSegmentedColormap.from_list("signed", np.vstack([cold, warm[1:]]), 255)


SIGNED = _diverging()
SIZE = mpl.colormaps["viridis"]
DENSITY = mpl.colormaps["magma"]
GLOW = mpl.colormaps["inferno"]
GREY = mpl.colormaps["gray"]
_MANY = (*COLOURS, *map(to_hex, mpl.colormaps["tab10"].colors[4:]))  # type: ignore[attr-defined]


def colour(n: int) -> str:
    """Colour of the n-th curve, "#rrggbb", the same in all figures of a page."""
    return _MANY[n % len(_MANY)]


def draw_path(axes: Axes, path: Path, **looks: Any) -> PathPatch:
    """Draw a path into axes whose limits are set separately; returns its patch.

    Unlike ``Axes.add_patch`` it does not compute the extent of every curved segment, which takes
    longer than drawing if the path is a specimen's boundary.
    """
    patch = PathPatch(path, **looks)
    axes.add_artist(patch)
    return patch


def scale_bar(axes: Axes, length: float, text: str) -> None:
    """Draw a scale bar of ``length`` [data units] below the lower left corner of the axes."""
    left, (bottom, top) = axes.get_xlim()[0], axes.get_ylim()
    drop = 0.012 * abs(top - bottom)
    axes.plot([left, left + length], [bottom - drop] * 2, color=INK, lw=1.6, clip_on=False,
              solid_capstyle="butt")  # fmt: skip
    axes.annotate(text, (left + 0.5 * length, bottom - drop), (0, -3), textcoords="offset points",
                  ha="center", va="top", fontsize=7.5, annotation_clip=False)  # fmt: skip


def to_svg(drawn: Figure, name: str, title: str, *, exact: bool = False) -> str:
    """Turn a figure into an SVG element for an HTML page.

    ``name``: prefix that makes the ids of this figure unique on the page. ``title``: description
    for screen readers. ``exact``: store raster images without loss, for fields as fine as the
    pixels, whose colours lossy compression would mix.
    """
    buffer = io.StringIO()
    width, height = drawn.get_size_inches()
    with style():
        pixels = cast(Any, _WebPRenderer)(72 * width, 72 * height, buffer, image_dpi=DPI)
        pixels.exact = exact
        drawn.dpi = 72
        renderer = cast(Any, MixedModeRenderer)(drawn, width, height, DPI, pixels)
        drawn.draw(renderer)
        renderer.finalize()
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].rstrip()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="(?:figure|axes|patch|line2d|matplotlib|text|xtick|ytick|[A-Za-z]+Coll'
                 r'ection|QuadMesh|LineCollection)[\w.]*"', "", svg)  # fmt: skip
    svg = re.sub(r' id="([^"]+)"', rf' id="{name}-\1"', svg)
    svg = svg.replace("url(#", f"url(#{name}-")
    svg = re.sub(r'xlink:href="#', f'href="#{name}-', svg).replace("xlink:href=", "href=")
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)  # it would apply to the whole page
    svg = re.sub(r"font: [^;\"]*?([\d.]+px)[^;\"]*", r"font-size: \1", svg)
    svg = re.sub(r"font-family: [^;\"]*;?", "", svg)
    svg = re.sub(r' d="([^"]*)"', _rounded, svg)
    svg = svg.replace(INK, "currentColor").replace(MUTED, "var(--muted)")
    box = re.search(r'viewBox="[^"]*"', svg)
    assert box is not None, "matplotlib's SVG has a viewBox"
    # Above 150 px an inch letters are too large; below 90, on a narrow screen, too small to read.
    size = f'style="max-width: {150 * width:.0f}px; --least: {90 * width:.0f}px"'
    head = f'<svg {box.group()} {size} role="img" aria-label="{escape(title)}">'
    return head + svg[svg.index(">") + 1 :]


def _rounded(found: re.Match[str]) -> str:
    """Cut a path's coordinates to 0.01 pt, which halves its size without a visible change."""
    return ' d="' + re.sub(r"(\.\d\d)\d+", r"\1", found.group(1)).replace(" \n", " ") + '"'


class _WebPRenderer(RendererSVG):
    """Writes SVG with raster images as WebP: lossless if exact, else a third of PNG's size."""

    exact = False

    def draw_image(self, gc: Any, x: float, y: float, im: Any, transform: Any = None) -> None:
        """Write a raster image ``im``, (rows, cols, 4) bytes, its lower left corner at x, y."""
        assert transform is None, "what is drawn as pixels has no transform left"
        rows, cols = im.shape[:2]
        width, height = 72 * cols / self.image_dpi, 72 * rows / self.image_dpi
        how = {"lossless": True, "quality": 50} if self.exact else {"quality": QUALITY}
        packed = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(im)).save(packed, format="webp", method=2, **how)
        place = {"x": x, "y": y + height - self.height, "width": width, "height": height}
        attributes = {name: f"{value:.6f}" for name, value in place.items()}
        attributes["transform"] = f"scale(1 -1) translate(0 {-height:.6f})"
        attributes["href"] = (
            "data:image/webp;base64," + base64.b64encode(packed.getvalue()).decode()
        )
        self.writer.element("image", attrib=attributes)  # type: ignore[no-untyped-call]
