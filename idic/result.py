"""What a correlation found, how sure it is, and how it got there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.files import read_record, write_json
from modeharvest.idic.agreement import LAGS_PX, Agreement
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.gauss_newton import Iteration, Outcome
from modeharvest.idic.serialise import result_fields, result_to_dict
from modeharvest.idic.weighting import SLOPE_NOISE, Weighting
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import SplineImage
from modeharvest.reading import reading

FloatArray = NDArray[np.float64]

FORMAT = "modeharvest-result-3"


@dataclass(frozen=True, eq=False)
class Result:
    """The unknowns with their covariance, and an account of the iteration.

    Parameters
    ----------
    ansatz
        The kinematics.
    grid
        The pixels of the full images.
    unknowns
        (n,): a, in the order of ``ansatz.names``.
    inverse
        (n, n): M^-1, the inverse of the Gauss-Newton matrix; times a variance of the residual
        it is the covariance. Infinite on the diagonal where nothing could be determined.
    residual_rms
        Root mean square of the residual over the pixels used: grey levels, or mm per component
        for a fit to a displacement.
    pixels, left_image
        Pixels used, and pixels mapped outside the deformed image. A fit to a displacement
        counts each pixel twice, once for each component.
    outcome
        Why the iteration ended, on the finest level.
    condition_number
        Of the column-scaled Gauss-Newton matrix.
    history
        Every iteration of every level.
    timings_s
        Seconds for each stage.
    residual_correlation
        Rms autocorrelation of the residual [-]: near 0 for noise; NaN for a fit to a
        displacement. See :meth:`agreement`.
    residual_lags_px
        How far apart it was taken [px].
    unmatched
        Share of the image in which f and g(x + u) have little to do with each other [-]; above
        0.1 the outcome is TRAPPED. NaN for a fit to a displacement.
    weighting
        Which gradient weighed the residual.
    """

    ansatz: Ansatz
    grid: PixelGrid
    unknowns: FloatArray
    inverse: FloatArray
    residual_rms: float
    pixels: int
    left_image: int
    outcome: Outcome
    condition_number: float
    history: tuple[Iteration, ...] = ()
    timings_s: Mapping[str, float] = field(default_factory=dict)
    residual_correlation: float = float("nan")
    unmatched: float = float("nan")
    residual_lags_px: tuple[int, ...] = LAGS_PX
    weighting: Weighting = field(default_factory=Weighting)

    def __post_init__(self) -> None:
        object.__setattr__(self, "unknowns", self.ansatz.checked(self.unknowns))
        inverse, n = np.asarray(self.inverse, dtype=np.float64), self.ansatz.size
        if inverse.shape != (n, n):
            raise InputError(f"expected an inverse of shape ({n}, {n}), got {inverse.shape}")
        object.__setattr__(self, "inverse", inverse)
        for array in (self.unknowns, self.inverse):
            array.setflags(write=False)

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each unknown."""
        return self.ansatz.names

    @property
    def iterations(self) -> int:
        """Iterations on the finest level."""
        finest = min((step.factor for step in self.history), default=1)
        return sum(step.factor == finest for step in self.history)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the unknowns that the images say nothing about."""
        lost = np.isinf(np.diag(self.inverse))
        return tuple(name for name, is_lost in zip(self.names, lost, strict=True) if is_lost)

    @property
    def noise_sd(self) -> float:
        """Grey-level noise of each image if the residual were nothing but noise in both.

        An upper bound: what the ansatz can't describe is in the residual too.
        """
        freedom = max(1, self.pixels - self.ansatz.size)
        return float(self.residual_rms * np.sqrt(max(1, self.pixels) / freedom / 2.0))

    def covariance(self, noise_sd: float | None = None, noisy_images: int = 2) -> FloatArray:
        """(n, n) covariance of the unknowns under white noise: for weak noise the Cramer-Rao bound.

        Parameters
        ----------
        noise_sd
            Standard deviation of the noise in an image [grey levels]; by default the one that
            makes the residual nothing but noise.
        noisy_images
            2 if both images are noisy, 2 s^2 M^-1; 1 if only the reference is, s^2 M^-1.

        Notes
        -----
        Two things that noise s in the deformed image does beyond that, in both of which the
        variance q s^2 of its own gradient counts against the speckle's G^2: it makes M larger,
        by 1 + q s^2/G^2, which is taken back; and it spoils the gradient that the residual is
        weighed with, which adds what :meth:`Weighting.excess` says. Where the noise isn't given,
        that is done if the residual is noise.

        The noise of the deformed image weighs 1/det F more: where the material has shrunk,
        neighbouring pixels of the reference share noise. That is not taken into account.
        """
        if noisy_images not in (1, 2):
            raise InputError(f"expected 1 or 2 noisy images, got {noisy_images}")
        # The residual holds the noise of however many images are noisy.
        variance = noisy_images * noise_sd**2 if noise_sd is not None else 2.0 * self.noise_sd**2
        is_noise = noise_sd is not None or self.agreement().is_white
        if noisy_images == 2 and is_noise and np.isfinite(self.residual_correlation):
            share = self.noise_in_gradient(0.5 * variance)
            variance *= (1.0 + share) * (1.0 + self.weighting.excess(share))
        return np.asarray(variance * self.inverse)

    def noise_in_gradient(self, variance: float) -> float:
        """q s^2/G^2 [-]: what noise adds to the deformed image's squared gradient.

        The columns of a constant v0 are the gradient; as large as 4 where noise is all there is.

        Parameters
        ----------
        variance
            s^2 of the noise in the deformed image [grey levels squared].
        """
        kept = np.flatnonzero(np.isfinite(np.diag(self.inverse)))
        matrix = np.linalg.inv(self.inverse[np.ix_(kept, kept)])
        constants = np.isin(kept, [self.ansatz.v0_slice(c).start for c in (0, 1)])
        if not constants.any():
            return 0.0
        seen = float(np.diag(matrix)[constants].mean()) / max(1, self.pixels)
        noise = SLOPE_NOISE * variance / self.grid.pixel_size**2
        return noise / max(seen - noise, 0.25 * noise)

    def agreement(
        self, noise_sd: float | None = None, noisy_images: int = 2, order: int = 5
    ) -> Agreement:
        """Whether the residual is noise: what the standard errors rest on.

        Parameters
        ----------
        noise_sd
            Standard deviation of the noise in an image [grey levels], if known; then chi
            squared is told, too.
        noisy_images
            2 if both images are noisy, 1 if only the reference is.
        order
            Of the spline that was used.
        """
        return Agreement.of(
            self.residual_rms,
            self.residual_correlation,
            self.pixels,
            self.ansatz.size,
            noise_sd,
            noisy_images,
            order,
            self.residual_lags_px,
        )

    def standard_errors(self, noise_sd: float | None = None) -> FloatArray:
        """(n,): square roots of the diagonal of :meth:`covariance`."""
        return np.sqrt(np.diag(self.covariance(noise_sd)))

    def displacement_sd(
        self, x: ArrayLike, y: ArrayLike, noise_sd: float | None = None
    ) -> FloatArray:
        """(..., 2): predicted standard deviation of u_x and u_y [mm] at positions [mm].

        Infinite where it depends on unknowns that the images say nothing about.

        Parameters
        ----------
        x, y
            Positions that broadcast together, or two axes; for maps take every tenth pixel or
            so: it is as smooth as the ansatz.
        noise_sd
            As for :meth:`covariance`.
        """
        S = self.ansatz.sensitivities(self.unknowns, x, y)
        covariance = self.covariance(noise_sd)
        lost = np.isinf(np.diag(covariance))
        covariance[np.ix_(lost, lost)] = 0.0
        variance = np.einsum("...n,nm,...m->...", S, covariance, S, optimize=True)
        touched = np.any(S[..., lost] != 0.0, axis=-1)
        return np.asarray(np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0))))

    def mode_parameters(self, i: int = 0) -> FloatArray:
        """(m,): the parameters of the mode number i (from 0)."""
        return self.unknowns[self.ansatz.phi_slice(i)]

    def displacement(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): u [mm] at the pixels of ``grid``, by default those of the images."""
        return self.ansatz.displacement(self.unknowns, *_axes(grid or self.grid))

    def v0(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): the slow field [mm]."""
        return self.ansatz.v0(self.unknowns, *_axes(grid or self.grid))

    def v(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols): the amplitude of the mode number i (from 0) [mm]."""
        return self.ansatz.v(i, self.unknowns, *_axes(grid or self.grid))

    def phi(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): the mode number i (from 0) [-]."""
        return self.ansatz.phi(i, self.unknowns, *_axes(grid or self.grid))

    def fluctuation(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): v_i phi_i of the mode number i (from 0) [mm]."""
        return self.ansatz.fluctuation(i, self.unknowns, *_axes(grid or self.grid))

    def residual(
        self, reference: NDArray[Any], deformed: NDArray[Any], order: int = 5
    ) -> FloatArray:
        """(rows, cols): f - g(x + u) [grey levels] in the reference frame; NaN off the image.

        Gain and offset are applied to g if they were unknowns.

        Parameters
        ----------
        reference, deformed
            (rows, cols) f and g, on :attr:`grid`.
        order
            Of the spline.
        """
        if reference.shape != self.grid.shape or deformed.shape != self.grid.shape:
            raise InputError(
                f"expected two images of {self.grid.shape} px, got {reference.shape} and "
                f"{deformed.shape}"
            )
        u = self.displacement() / self.grid.pixel_size
        row, col = np.indices(self.grid.shape)
        value, _, _ = SplineImage.of(deformed, order).sample(row - u[..., 1], col + u[..., 0])
        gain, offset = self.ansatz.gain_and_offset(self.unknowns, *_axes(self.grid))
        return np.asarray(reference - gain * value - offset)

    def write(self, path: Path | str) -> None:
        """Write JSON, atomically; every number comes back as it was."""
        write_json(path, {"format": FORMAT, **result_to_dict(self)})

    @classmethod
    def read(cls, path: Path | str) -> Result:
        """Read what :meth:`write` wrote.

        Raises
        ------
        InputError
            If the file is missing, cut short or of another format.
        """
        what, remedy = f"a complete {FORMAT} file", "correlate again"
        with reading(path, what, remedy):
            return cls(**result_fields(read_record(path, FORMAT, what, remedy)))


def _axes(grid: PixelGrid) -> tuple[FloatArray, FloatArray]:
    return grid.x, grid.y
