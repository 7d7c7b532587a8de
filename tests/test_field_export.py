"""Fields written as other codes write them, and read back: the same numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeharvest.idic.local.export import FORMATS, export_field
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

GRID = PixelGrid(60, 80, 0.05, -1.3, 2.1)
ROW, COL = (a.ravel().astype(float) for a in np.mgrid[4:60:4, 8:80:4])
X, Y = GRID.to_mm(ROW, COL)
U = np.column_stack([0.031 + 0.01 * X, 0.02 * X - 0.04 * Y])
GOOD = np.arange(X.size) != 17
FIELD = LocalField(X, Y, U, GOOD, np.full(U.shape, 2e-3))
OF_GRIDS = ("ncorr", "davis")
WITH_SD = ("vic2d", "dice", "csv", "npz", "mat")


@pytest.mark.parametrize("form", FORMATS)
def test_what_is_written_is_read_back_without_options(tmp_path: Path, form: str) -> None:
    path = export_field(tmp_path / "field", FIELD, form, GRID)
    assert path.suffix == FORMATS[form]
    field = read_field(path, GRID)
    found = np.column_stack([field.x, field.y, field.u])[field.good]
    true = np.column_stack([X, Y, U])[GOOD]
    np.testing.assert_allclose(found, true, atol=1e-9)
    assert form in OF_GRIDS or field.lost == 1
    assert (field.sd is not None) == (form in WITH_SD)
    if field.sd is not None:
        np.testing.assert_allclose(field.sd[field.good], 2e-3, rtol=1e-6)


@pytest.mark.parametrize("form", FORMATS)
def test_a_field_without_standard_deviations_has_none_later(tmp_path: Path, form: str) -> None:
    path = export_field(tmp_path / "field", replace(FIELD, sd=None), form, GRID)
    assert read_field(path, GRID).sd is None


@pytest.mark.parametrize("form", OF_GRIDS)
def test_codes_with_grids_want_whole_pixels(tmp_path: Path, form: str) -> None:
    with pytest.raises(InputError, match=r"whole pixels .* write VIC-2D's or DICe's"):
        export_field(tmp_path / "field", replace(FIELD, x=X + 0.01), form, GRID)


def test_millimetres_need_the_size_of_a_pixel(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected the size of a pixel for gom"):
        export_field(tmp_path / "field", FIELD, "gom", GRID, "px")
    with pytest.raises(InputError, match="expected a format among ncorr"):
        export_field(tmp_path / "field", FIELD, "vic", GRID)
