"""The fields that a page's reader can explore, unpacked as the page does it."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLOATS = NDArray[np.float64]


def content_of(text: str) -> dict[str, Any]:
    """What a page holds for its explorer."""
    found = re.search(r'id="explore-data">(.*?)</script>', text, re.DOTALL)
    assert found is not None, "a page with fields to explore"
    return dict(json.loads(found.group(1)))


def unpacked(entry: Mapping[str, Any], masks: list[str], shape: tuple[int, int]) -> FLOATS:
    """(rows, cols) a packed array, NaN where nothing is known."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(entry["data"])), dtype=np.uint8)
    low, high = data.reshape(2, -1).astype(np.uint16)
    coded = (low | high << 8).reshape(shape)
    if entry["predicted"]:
        change = ((coded >> 1) ^ -(coded & 1).astype(np.int32)).astype(np.int64)
        coded = (np.cumsum(np.cumsum(change, axis=0), axis=1) % 65536).astype(np.uint16)
    values = entry["low"] + entry["step"] * coded.astype(np.float64)
    if entry["mask"] >= 0:
        bits = zlib.decompress(base64.b64decode(masks[entry["mask"]]))
        known = np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")[: values.size]
        values[known.reshape(shape) == 0] = np.nan
    return values


def quantity(content: Mapping[str, Any], state: int, key: str, which: str = "terms") -> FLOATS:
    """(rows, cols) a quantity of a state, measured or the "truth", in the page's unit."""
    (entry,) = (q for q in content["quantities"] if q["key"] == key)
    shape = content["rows"], content["cols"]
    arrays = content["states"][state]["arrays"]
    sums = [
        sum(
            factor * unpacked(content["packed"][arrays[name]], content["masks"], shape)
            for name, factor in part.items()
        )
        for part in entry[which]
    ]
    return np.asarray(sums[0] if len(sums) == 1 else np.linalg.norm(sums, axis=0))


def samples(content: Mapping[str, Any], field: NDArray[Any]) -> NDArray[Any]:
    """The pixels of a field (rows, cols, ...) of the images that a page holds."""
    (row, col), factor = content["first"], content["factor"]
    rows = row + factor * np.arange(content["rows"])
    return field[np.ix_(rows, col + factor * np.arange(content["cols"]))]
