"""RVEs for other codes: what the files say, found again from nothing else, with numpy alone."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray
from test_examples import ROOT, load

from modeharvest.fem.lattice.cells import hexagonal, square
from modeharvest.fem.lattice.micromorphic.patterns import rotation_pattern
from modeharvest.fem.lattice.micromorphic.rve import RVE, RVEState
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.runs.homogenization.export import QUANTITIES, write_fe2, write_rve
from modeharvest.util.errors import InputError
from modeharvest.validation.homogenization import LatticeMode, MeasuredModes, ModeParameters

FloatArray = NDArray[np.float64]
PITCH, JUNCTION = 1.9, (0.95, 0.95)
READER, REBUILDER = (ROOT / "examples" / name for name in ("read_rve.py", "rve_stress.py"))
reader = sys.modules["read_rve"] = load(READER)
rebuilder = load(REBUILDER)  # imports the reader that stands beside it
LAWS = [Ogden((0.9, 0.5), (3.0, -1.5), 5.4), TwoTermI1()]


@cache
def rve(number: int = 0) -> RVE:
    cell = square(PITCH, 1.5, 0.5).enlarged(2, 2)
    return RVE(cell, LAWS[number], [rotation_pattern(PITCH)], JUNCTION)


def random_strains(count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    F = np.eye(2).ravel() + rng.uniform(-0.06, 0.06, (count, 4))
    v, g = rng.uniform(-0.15, 0.15, (count, 1)), rng.uniform(-0.03, 0.03, (count, 2))
    return np.hstack([F, v, g])


@cache
def states(number: int) -> tuple[RVEState, ...]:
    return tuple(rve(number).equilibrium(q) for q in random_strains(3, number))


def written(path: Path, number: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    write_rve(path, rve(number), states(number))
    return read(path)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """All arrays, and the constants of the law."""
    arrays, attributes = reader.read(path)
    return arrays, attributes["material/0"]


@pytest.mark.parametrize("number", [0, 1])
def test_mean_stresses_are_rebuilt(number: int, tmp_path: Path) -> None:
    file, law = written(tmp_path / "rve.h5", number)
    for q, w, stresses in zip(
        file["states/strains"], file["states/fluctuations"], file["states/stresses"], strict=True
    ):
        found = rebuilder.mean_stress(file, law, rebuilder.displacement(file, q, w))
        np.testing.assert_allclose(found.ravel(), stresses[:4], rtol=0, atol=1e-13)


def test_the_reader_is_short_and_needs_h5py_alone(tmp_path: Path) -> None:
    file, law = written(tmp_path / "rve.h5")
    lines = READER.read_text("utf-8").splitlines()
    assert len(lines) <= 30
    assert [line for line in lines if line.startswith(("import", "from"))] == [
        "import sys", "import h5py"
    ]  # fmt: skip
    assert law["kind"] == "Ogden"
    printed = run(READER, tmp_path / "rve.h5").splitlines()
    assert len(printed) == len(file)
    for text in ("nodes", f"{file['nodes'].shape} [mm]: undeformed, from the RVE's centre"):
        assert text in next(line for line in printed if line.startswith("nodes "))


def test_stresses_are_rebuilt_without_the_program(tmp_path: Path) -> None:
    written(tmp_path / "rve.h5")
    imported = {"import sys", "import numpy as np", "from read_rve import read"}
    lines = REBUILDER.read_text("utf-8").splitlines()
    assert {line for line in lines if line.startswith(("import", "from"))} == imported
    count, _, off = run(REBUILDER, tmp_path / "rve.h5").partition(" states: P rebuilt within ")
    assert int(count) == 3
    assert float(off.split()[0]) < 1e-13


def run(script: Path, file: Path) -> str:
    """What an example prints in a process of its own."""
    command = [sys.executable, script, file]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_pairs_are_a_lattice_vector_apart(tmp_path: Path) -> None:
    file, _ = written(tmp_path / "rve.h5")
    images, sources = file["pairs"].T
    assert not set(images) & set(sources)
    assert len(set(images)) == len(images)
    assert file["fixed_node"] in sources
    apart = file["nodes"][images] - file["nodes"][sources]
    np.testing.assert_allclose(apart, file["shifts"] @ file["lattice"], atol=1e-12)
    assert np.abs(file["shifts"]).sum(axis=1).min() == 1
    for field in (*file["modes"], *file["states/fluctuations"]):
        np.testing.assert_allclose(field[images], field[sources], atol=1e-12)
    assert file["area"] == pytest.approx(abs(np.linalg.det(file["lattice"])))
    # The nodes without the images make up the lattice: no two are a lattice vector apart.
    rest = np.delete(file["nodes"], images, axis=0)
    places = np.mod(rest @ np.linalg.inv(file["lattice"]) + 1e-6, 1.0)
    assert len(np.unique(np.round(places, 4), axis=0)) == len(rest)


def test_modes_are_their_waves_less_the_mean(tmp_path: Path) -> None:
    file, _ = written(tmp_path / "rve.h5")
    wave = {name: file[f"waves/0/{name}"] for name in ("vectors", "cosine", "sine")}
    angle = file["nodes"] @ wave["vectors"].T
    field = file["scales"][0] * (np.cos(angle) @ wave["cosine"] + np.sin(angle) @ wave["sine"])
    mean = file["modes"][0] - field
    np.testing.assert_allclose(mean, np.broadcast_to(mean[0], mean.shape), atol=1e-12)
    # In the frame of the lattice a hole's centre is the origin.
    np.testing.assert_allclose(
        field, file["scales"][0] * rotation_pattern(PITCH)(file["nodes"] + file["centre"]),
        atol=1e-12,
    )  # fmt: skip
    phases = file["lattice"] @ wave["vectors"].T / (2 * np.pi)
    np.testing.assert_allclose(phases, np.rint(phases), atol=1e-12)


def shape_functions(b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(p, 6) of six-node triangles and (p, 6, 2) their derivatives by b and c, written anew."""
    a, o = 1 - b - c, np.zeros_like(b)
    N = [a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a]
    by_b = [1 - 4 * a, 4 * b - 1, o, 4 * (a - b), 4 * c, -4 * c]
    by_c = [1 - 4 * a, o, 4 * c - 1, -4 * b, 4 * b, 4 * (a - c)]
    return np.stack(N, axis=1), np.stack([np.stack(by_b, 1), np.stack(by_c, 1)], axis=2)


def test_averages_are_integrals_over_the_material(tmp_path: Path) -> None:
    """By a rule of 25 points, which is exact for products of six-node triangles."""
    file, _ = written(tmp_path / "rve.h5")
    x, weight = np.polynomial.legendre.leggauss(5)
    s, t = (0.5 * (1 + g.ravel()) for g in np.meshgrid(x, x))
    N, slopes = shape_functions(s, t * (1 - s))
    factor = 0.25 * np.outer(weight, weight).ravel() * (1 - s)
    J = np.einsum("pkx,eky->epyx", slopes, file["nodes"][file["cells"]])
    dA = factor * np.linalg.det(J)
    w = np.random.default_rng(1).normal(size=file["nodes"].shape)

    def mean(*fields: FloatArray) -> FloatArray:
        first, *others = (np.einsum("pk,ek...->ep...", N, f[file["cells"]]) for f in fields)
        product = np.sum(first * others[0], axis=-1) if others else first
        return np.einsum("ep,ep...->...", dA, product)

    (phi,), area = file["modes"], file["area"]
    free = w - mean(w) / dA.sum()
    expected = [*mean(w), mean(free, phi)]
    expected += [mean(free, phi * X[:, None]) for X in file["nodes"].T]
    found = np.einsum("knx,nx->k", file["averages"], w)
    np.testing.assert_allclose(found, np.array(expected) / area, rtol=0, atol=1e-13)
    np.testing.assert_allclose(mean(phi), 0.0, atol=1e-13)
    assert mean(phi, phi) / dA.sum() == pytest.approx(1.0), "normalised: rms"
    for fluctuation in file["states/fluctuations"]:
        left = np.einsum("knx,nx->k", file["averages"], fluctuation)
        np.testing.assert_allclose(left, 0.0, atol=1e-13)


class Independent:
    """The RVE of a file by numpy alone: residual by the example's law, moduli by differences."""

    def __init__(self, file: dict[str, Any], law: dict[str, Any]) -> None:
        self.file, self.law, self.count = file, law, len(file["nodes"])
        third = (1 + 3 * np.eye(3)) / 6
        _, slopes = shape_functions(third[1], third[2])
        J = np.einsum("pkx,eky->epyx", slopes, file["nodes"][file["cells"]])
        self.grad = np.einsum("pkx,epxy->epky", slopes, np.linalg.inv(J))
        self.dA = np.linalg.det(J) / 6
        kept = np.setdiff1d(np.arange(self.count), file["pairs"][:, 0])
        master = np.arange(self.count)
        master[file["pairs"][:, 0]] = file["pairs"][:, 1]
        places = np.searchsorted(kept, master)
        T = np.zeros((self.count, 2, len(kept), 2))
        for axis in (0, 1):
            T[np.arange(self.count), axis, places, axis] = 1.0
        T = T[:, :, kept != file["fixed_node"]]
        self.T = T.reshape(2 * self.count, -1)
        # Without <w>: a node is fixed, and the others of w - <w> are blind to translations.
        self.C = file["averages"][2:].reshape(-1, 2 * self.count) @ self.T
        none = np.zeros((self.count, 2))
        rest = np.array([1.0, 0, 0, 1.0, 0, 0, 0])
        columns = [rebuilder.displacement(file, rest + unit, none) for unit in np.eye(7)]
        self.M = np.reshape(columns, (7, -1)).T

    def stress(self, u: FloatArray) -> FloatArray:
        H = np.einsum("epky,ekx->epxy", self.grad, u[self.file["cells"]])
        return np.asarray(rebuilder.stress(np.eye(2) + H, self.law))

    def assembled(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        cells = self.file["cells"]
        H = np.einsum("epky,ekx->epxy", self.grad, u[cells])
        P, h = rebuilder.stress(np.eye(2) + H, self.law), 1e-5
        A = np.empty((*P.shape, 2, 2))
        for i in (0, 1):
            for j in (0, 1):
                dH = np.zeros((2, 2))
                dH[i, j] = h
                plus, minus = (rebuilder.stress(np.eye(2) + H + s * dH, self.law) for s in (1, -1))
                A[..., i, j] = (plus - minus) / (2 * h)
        f, K = np.zeros((self.count, 2)), np.zeros((self.count, 2, self.count, 2))
        np.add.at(f, cells, np.einsum("ep,epky,epxy->ekx", self.dA, self.grad, P))
        k = np.einsum("ep,epky,epxyzw,eplw->ekxlz", self.dA, self.grad, A, self.grad)
        for e, nodes in enumerate(cells):
            K[np.ix_(nodes, (0, 1), nodes, (0, 1))] += k[e]
        return f.ravel(), K.reshape(2 * self.count, -1)

    def equilibrium(self, q: FloatArray, parts: int = 4) -> tuple[FloatArray, FloatArray]:
        """(7,) stresses and (7, 7) moduli, from the undeformed state in steps."""
        rest, w = np.array([1.0, 0, 0, 1.0, 0, 0, 0]), np.zeros(self.T.shape[1])
        zero = np.zeros((len(self.C), len(self.C)))
        for part in np.arange(1, parts + 1) / parts:
            here = rest + part * (q - rest)
            for _ in range(12):
                u = rebuilder.displacement(self.file, here, (self.T @ w).reshape(-1, 2))
                f, K = self.assembled(u)
                saddle = np.block([[self.T.T @ K @ self.T, self.C.T], [self.C, zero]])
                sides = [-self.T.T @ f, *(-self.T.T @ K @ self.M).T]
                known = [np.concatenate([side, np.zeros(len(self.C))]) for side in sides]
                solved = np.linalg.solve(saddle, np.stack(known, axis=1))[: len(w)]
                w = w + solved[:, 0]
                if np.abs(solved[:, 0]).max() < 1e-12:
                    break
        area = float(self.file["area"])
        return self.M.T @ f / area, self.M.T @ K @ (self.M + self.T @ solved[:, 1:]) / area


@pytest.mark.parametrize("number", [0, 1])
def test_an_independent_solver_finds_the_same_stresses_and_moduli(
    number: int, tmp_path: Path
) -> None:
    """From nothing but what the reader reads, at random strains."""
    file, law = written(tmp_path / "rve.h5", number)
    q = random_strains(1, 17)[0]
    stresses, moduli = Independent(file, law).equilibrium(q)
    expected = rve(number).equilibrium(q)
    np.testing.assert_allclose(stresses, expected.stresses, rtol=1e-9, atol=1e-13)
    # Its dP/dF are by differences of 1e-5: nine digits of the largest are right.
    scale = np.abs(expected.moduli).max()
    np.testing.assert_allclose(moduli, expected.moduli, rtol=0, atol=1e-8 * scale)


def test_stresses_and_moduli_are_derivatives(tmp_path: Path) -> None:
    q, h, element = random_strains(1, 3)[0], 1e-5, rve()
    pairs = [[element.equilibrium(q + s * h * e) for s in (1, -1)] for e in np.eye(7)]
    around = [state for pair in pairs for state in pair]
    write_rve(tmp_path / "rve.h5", element, [element.equilibrium(q), *around])
    file, _ = read(tmp_path / "rve.h5")
    moduli, stresses, energy = (file[f"states/{n}"] for n in ("moduli", "stresses", "energy"))
    np.testing.assert_allclose((energy[1::2] - energy[2::2]) / (2 * h), stresses[0], atol=1e-10)
    slopes = (stresses[1::2] - stresses[2::2]).T / (2 * h)
    np.testing.assert_allclose(slopes, moduli[0], atol=1e-8 * np.abs(moduli[0]).max())


def test_every_array_says_its_unit_as_the_page_does(tmp_path: Path) -> None:
    write_rve(
        tmp_path / "rve.h5", rve(), states(0), errors(), loads=[0.1] * 3,
        points=np.zeros((3, 2)), buckled=[True] * 3,
    )  # fmt: skip
    table = (ROOT / "docs/reference/rve.md").read_text("utf-8").splitlines()
    rows = [[c.strip(" `") for c in line.split("|")[1:-1]] for line in table if line[:3] == "| `"]
    documented = {row[0].split("/")[-1]: row for row in rows}
    found = dict[str, h5py.Dataset]()
    with h5py.File(tmp_path / "rve.h5") as file:
        file.visititems(lambda name, thing: found.update({name: thing}))
        arrays = {n: thing for n, thing in found.items() if isinstance(thing, h5py.Dataset)}
        for name, array in arrays.items():
            leaf = name.split("/")[-1]
            assert array.attrs["unit"] == QUANTITIES[leaf][0] == documented[leaf][2], name
            assert array.attrs["meaning"] == QUANTITIES[leaf][1], name
        assert {name.split("/")[-1] for name in arrays} == set(QUANTITIES)
        assert list(file.attrs["strains"]) == ["F11", "F12", "F21", "F22", "v1", "dv1/dx", "dv1/dy"]
        assert len(file.attrs["stresses"]) == len(file.attrs["stress_units"]) == 7


def errors() -> MeasuredModes:
    specimen = Specimen(6, 10)
    (mode,) = Ansatz.of_specimen(specimen).modes
    sd = np.array([0.02, *4 * [1e-3], 0.01, 0.01])
    names = tuple(f"a{k + 1}" for k in range(7))
    units, covariance = 5 * ("-",) + 2 * ("mm",), np.diag(sd**2)
    known = ModeParameters(names, units, mode.family.start, 0.01 * covariance, covariance)
    vectors = 2 * specimen.pitch * np.eye(2)

    def snapped(parameters: FloatArray) -> list[LatticeMode]:
        return [LatticeMode.of(mode, parameters, specimen, vectors)]

    return MeasuredModes(known, snapped)


def test_a_measured_mode_has_its_error_bars(tmp_path: Path) -> None:
    """Monte Carlo over parameters: the scatter of phi at the nodes is what the file says."""
    known = errors()
    mode = known.modes(known.parameters.values)[0].snapped
    element = RVE(square(PITCH, 1.5, 0.5).enlarged(2, 2), Ogden(), [mode], JUNCTION, "given")
    write_rve(tmp_path / "rve.h5", element, measured=known)
    file, _ = read(tmp_path / "rve.h5")
    wave = {name.removeprefix("waves/0/"): a for name, a in file.items() if "waves/0/" in name}
    assert wave["covariance"].shape == (4 * len(wave["vectors"]),) * 2
    angle = file["nodes"] @ wave["vectors"].T
    basis = np.hstack([np.cos(angle), np.sin(angle)])  # (n, 2 w)
    C = wave["covariance"].reshape(basis.shape[1], 2, basis.shape[1], 2)
    sd = np.sqrt(np.maximum(np.einsum("nw,wxvx,nv->nx", basis, C, basis), 0.0))
    rng = np.random.default_rng(0)
    covariance = file["measured/by_model_error"]
    draws = rng.multivariate_normal(file["measured/parameters"], covariance, 400)
    fields = [known.modes(p)[0].snapped(file["nodes"] + file["centre"]) for p in draws]
    scatter = np.std(fields, axis=0)
    # 400 draws: 3.5 % of a standard deviation, and 4 of those at the worst of all nodes.
    np.testing.assert_allclose(sd, scatter, atol=0.15 * scatter.max())
    assert scatter.max() > 1e-4
    np.testing.assert_allclose(wave["covariance"], wave["derivatives"] @ covariance
                               @ wave["derivatives"].T, atol=1e-15)  # fmt: skip
    assert np.abs(wave["derivatives"][:, 1:]).max() < 1e-12, "waves and phases are the lattice's"


def test_matlab_finds_the_layout_of_the_fe2_code(tmp_path: Path) -> None:
    write_fe2(tmp_path / "rve.mat", rve(1))
    file = scipy.io.loadmat(tmp_path / "rve.mat", simplify_cells=False)
    mesh = file["RVEmesh"][0, 0]
    nodes, elements, fe2 = mesh["nodes"], mesh["elements"], mesh["FE2"][0, 0]
    assert nodes.shape == (mesh["nNodes"].item(), 3)
    assert elements.shape == (mesh["nElems"].item(), 6)
    assert mesh["elemMats"].shape == (len(elements), 1)
    assert elements.dtype == np.float64
    assert (elements.min(), elements.max()) == (1, len(nodes))
    at = nodes[elements.astype(int) - 1, :2]
    sides = [(0, 3, 1), (1, 4, 2), (2, 5, 0)]  # as that code walks along an element's edges
    for a, middle, b in sides:
        chord = np.linalg.norm(at[:, b] - at[:, a], axis=1)
        off = np.linalg.norm(at[:, middle] - 0.5 * (at[:, a] + at[:, b]), axis=1)
        assert (off < 0.2 * chord).all()
    u, v = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    assert (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0).all(), "it refuses negative Jacobians"
    sources, images = fe2["periodicSourceNodes"], fe2["periodicImageNodes"]
    assert sources.shape == images.shape == (len(images), 1)
    apart = (nodes[images.ravel().astype(int) - 1] - nodes[sources.ravel().astype(int) - 1])[:, :2]
    shifts = apart / (2 * PITCH)
    np.testing.assert_allclose(shifts, np.rint(shifts), atol=1e-12)
    assert fe2["V"].item() == pytest.approx((2 * PITCH) ** 2)
    assert fe2["fixedNode"].item() in sources
    # Its numbers of unknowns: cumsum of what is neither image nor fixed; images as their sources.
    kept = np.ones(len(nodes), bool)
    kept[images.ravel().astype(int) - 1] = False
    kept[int(fe2["fixedNode"].item()) - 1] = False
    number = np.cumsum(kept) * kept
    number[images.ravel().astype(int) - 1] = number[sources.ravel().astype(int) - 1]
    assert number.max() == rve(1).cell.reduction.periodicity.count - 1
    assert (np.bincount(number)[1:] >= 1).all()
    (phi,) = mesh["phi"].ravel()
    np.testing.assert_array_equal(phi.reshape(-1, 2), rve(1).shapes[0])
    np.testing.assert_array_equal(file["microMaterials"], [[2, 0.55, 0.3, 0, 0, 0, 55, 1]])
    first = (tmp_path / "rve.mat").read_bytes()
    write_fe2(tmp_path / "rve.mat", rve(1))
    assert (tmp_path / "rve.mat").read_bytes() == first, "no date in it"
    write_fe2(tmp_path / "rve.mat", rve(0))
    assert "microMaterials" not in scipy.io.loadmat(tmp_path / "rve.mat"), "no such law there"


def test_any_number_of_modes_has_its_place(tmp_path: Path) -> None:
    cell = hexagonal(1.4, 1.2, 0.3).enlarged(2, 2)
    k = 2 * np.pi * np.linalg.inv(cell.lattice).T
    fields = [np.stack([np.cos(cell.mesh.nodes @ k[i]), np.sin(cell.mesh.nodes @ k[j])], axis=1)
              for i, j in ((0, 0), (1, 1), (0, 1))]  # fmt: skip
    for count in (0, 3):
        element = RVE(cell, Ogden(), fields[:count])
        state = element.equilibrium(element.at_rest * 0.99 + 0.0)
        write_rve(tmp_path / "rve.h5", element, [state])
        write_fe2(tmp_path / "rve.mat", element)
        file, law = read(tmp_path / "rve.h5")
        assert file["modes"].shape == (count, len(file["nodes"]), 2)
        assert file["averages"].shape == (2 + 3 * count, len(file["nodes"]), 2)
        u = rebuilder.displacement(file, file["states/strains"][0], file["states/fluctuations"][0])
        found = rebuilder.mean_stress(file, law, u).ravel()
        np.testing.assert_allclose(found, file["states/stresses"][0, :4], atol=1e-13)
        assert scipy.io.loadmat(tmp_path / "rve.mat")["RVEmesh"][0, 0]["phi"].size == count


def test_strains_without_an_equilibrium_are_refused() -> None:
    with pytest.raises(InputError, match=r"RVE: expected 7 finite strains"):
        rve().equilibrium([1.0, 0.0, 0.0, 1.0])
    with pytest.raises(InputError, match=r"found none farther than 0\.\d+ of the way"):
        rve().equilibrium([-0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # det F would be negative


def test_a_large_step_is_divided() -> None:
    """Newton's method alone does not come there from the undeformed state."""
    q = np.array([0.95, 0.01, -0.02, 1.03, 0.1, 0.02, -0.01])
    here, none = rve(1), np.zeros_like(rve(1).cell.cell.mesh.nodes)
    assert here._near(q, none) is None
    state = here.equilibrium(q)
    again = here.equilibrium(q, state.fluctuation)
    np.testing.assert_allclose(again.fluctuation, state.fluctuation, atol=1e-13)
    np.testing.assert_allclose(again.stresses, state.stresses, atol=1e-13)
