"""What a star set's README says: what is there, what to return, how it is graded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_TEXT = """\
# Star pattern {id}: how fine a displacement does your code resolve?

Images of a speckle moved by a wave whose period grows along the image, from {shortest:g} px at the
left to {longest:g} px at the right: the star of DIC Challenge 2.0 (P. L. Reu et al., Exp. Mech.
2022, doi 10.1007/s11340-021-00806-6).

## What is here

| file | content |
|---|---|
{files}

`star.json` says the same to programs, with every value needed to make the set again.

## The displacement

With the row *i* (down) and the column *j*, from 0 at the upper left pixel's centre, in px:

    v(i, j) = {amplitude:g} cos(2 pi (i - {centre}) / p(j))   (positive down),   u = 0
    p(j) = {shortest:g} + {range:g} j / {last}

It belongs to points of the *reference* image: a deformed pixel x shows the point X with
X + u(X) = x, found by Newton's method (largest residual {residual:.1e} px); there the speckle, a
trigonometric polynomial, is evaluated. Nothing is interpolated.

## What to return

Two fields, with one choice of subset, step and filter for both: one of `reference` to `deformed`,
one of `reference` to `still` (the same scene with other noise) of a level of noise. CSV, NPZ, HDF5,
MAT or VTU, points in any order, as dense as you like along the centre row and about it. In pixels,
*y* and *v* down:

```
# benchmark: {id}
x [px],y down [px],u [px],v down [px]
120,{centre},0.0031,0.482
124,{centre},nan,nan
```

Points that your code could not measure stay in the file, as NaN: they are counted.

## How it is graded

```sh
modeharvest benchmark resolution STAR.csv --still STILL.csv --set DIR --out graded
```

- *l*₁₀ %: the period at which 10 % of the amplitude is lost [px].
- *n*: the standard deviation of *v* between the two images without motion [px].
- *n l*₁₀ %, the metrological efficiency indicator [px²]: less is better. A larger subset lowers
  *n* and raises *l*₁₀ %; for a given code and speckle their product hardly changes.

## Licence

The images are free under CC-BY 4.0, https://creativecommons.org/licenses/by/4.0/: use them, and
name where they are from. Made with {made_with}.
"""

_ROLES = {
    "reference": "before the motion",
    "still": "the same again, with other noise",
    "deformed": "after it",
}


def readme(info: Mapping[str, Any]) -> str:
    """The README of a set, Markdown, from the content of its ``star.json``."""
    star = info["spec"]["star"]
    return _TEXT.format(
        id=info["id"],
        made_with=info["made_with"],
        files="\n".join(_row(name, info) for name in info["files"]),
        amplitude=star["amplitude_px"],
        shortest=star["shortest_px"],
        longest=star["longest_px"],
        range=star["longest_px"] - star["shortest_px"],
        last=star["cols"] - 1,
        centre=star["rows"] // 2,
        residual=info["law"]["residual_of_inversion_px"],
    )


def _row(name: str, info: Mapping[str, Any]) -> str:
    """A row of the table of files."""
    role, _, level = name.removesuffix(".tif").partition("_")
    percent = level.removesuffix("pct").replace("p", ".")
    camera = f"{info['spec']['bits']} bit, noise {percent} % of full scale"
    kind = camera if level else "exact, float"
    return f"| `{name}` | {_ROLES[role]}; {kind} |"
