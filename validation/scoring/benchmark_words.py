"""What a benchmark's README says: what is there, what to return, how it is graded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RETURNED = {
    "what": "the displacement of material points, at their positions in the reference image",
    "columns": ["x [px]", "y down [px]", "u [px]", "v down [px]"],
    "origin": "the centre of the upper left pixel is (0, 0)",
    "lost": "points that were not measured stay in the file, with NaN as u and v",
    "id": "a first line '# benchmark: ID' lets a mistaken file be noticed",
    "formats": ["csv", "npz", "h5", "mat", "vtu"],
}
"""How displacements are to be returned."""

_TEXT = """\
# Benchmark {id} for digital image correlation

Images of a specimen with holes, before and after a deformation, made by computer: the displacement
of every point is known, and is not in this folder. Measure it, and have your field graded.

## What is here

| file | content |
|---|---|
{files}

The float images hold grey levels as fractions of full scale, as exact as they could be made; the
{bits}-bit images are what a camera would have stored. Say which you used. Holes and surroundings
are {background:g}. The specimen's unit cells measure {unit_cell_mm:g} mm, a pixel
{pixel_size_mm:g} mm. `{mask}` is white where the reference image shows material.
`benchmark.json` says the same to programs, with the SHA-256 of every image.

## What to return

For each deformed image one file with the displacement *u, v* of material points at their positions
*x, y* in the **reference** image: CSV, NPZ, HDF5, MAT or VTU, points in any order or a grid. For
example, in pixels, *y* and *v* down, the centre of the upper left pixel being (0, 0):

```
# benchmark: {id}
x [px],y down [px],u [px],v down [px]
120,85,3.217,-0.482
125,85,nan,nan
```

Points that your code could not measure stay in the file, as NaN: they are counted. In millimetres,
with *y* up, the centre of the upper left pixel is at x = {x0:.6g} mm, y = {y0:.6g} mm.

## How it is graded

Who has the truth runs

```sh
modeharvest score FIELD.csv --truth TRUTH --strain {strain:g} --out graded
```

The error is the returned displacement less the true one at the returned positions, evaluated on
the finite elements that the images were made of. Told are its mean (bias), its rms per component,
percentiles and the largest length, over all and by region (within 10 px of an edge, ligaments,
junctions, bulk), the share of points that were measured, the share of the material that they
cover, and the error's spectrum. Fields are ranked by rms; those that cover less than half of the
material come after those that cover more.

## How it was made

A hyperelastic finite-element simulation deforms the specimen; a random speckle pattern moves with
it. For each pixel of a deformed image the material point that it shows is found by inverting the
isoparametric mapping, and the pattern is evaluated there, not interpolated. Method: section
"Virtual Experiments" of doi 10.1016/j.ijsolstr.2024.112916. Made with {made_with}.

Whoever made this set of a case that is public has not hidden its truth from those who can simulate
it again.

## Licence

The images are free under CC-BY 4.0, https://creativecommons.org/licenses/by/4.0/: use them, and
name where they are from.
"""


def readme(info: Mapping[str, Any]) -> str:
    """The README of a set, Markdown, from the content of its ``benchmark.json``."""
    first = info["first_pixel_mm"]
    return _TEXT.format(
        **{key: info[key] for key in ("id", "bits", "background", "unit_cell_mm", "pixel_size_mm",
                                      "made_with")},
        mask=info["reference"]["mask"],
        files="\n".join(_files(info)),
        strain=info["deformed"][-1]["nominal_strain"],
        x0=first["x"],
        y0=first["y_up"],
    )  # fmt: skip


def _files(info: Mapping[str, Any]) -> list[str]:
    """A row of the table for each file."""
    reference, bits = info["reference"], info["bits"]
    size = f"{info['rows']} × {info['cols']} px"
    rows = [
        f"| `{reference['image']}` | undeformed, float, {size} |",
        f"| `{reference['camera_image']}` | undeformed, {bits} bit |",
        f"| `{reference['mask']}` | material of the undeformed image |",
    ]
    for entry in info["deformed"]:
        strain = f"nominal strain {100 * entry['nominal_strain']:g} %"
        rows += [f"| `{entry['image']}` | {strain}, float |",
                 f"| `{entry['camera_image']}` | {strain}, {bits} bit |"]  # fmt: skip
    return rows
