"""The finite-element path compared with a simple load loop; its mesh convergence and cost.

``scripts/env python benchmarks/fem_path.py`` prints, for the 6 x 10 and the 12 x 10 specimen, the
results of ``simulate`` and of the loop, and their processor times. ``--table`` prints mesh
convergence and cost instead, ``--ranks SIZE`` the speed-up by a second MPI rank. Seconds depend on
the machine; ratios of successive runs hardly depend on it. Tables: docs/explanation/fem.md.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import dolfinx
import numpy as np
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from modeharvest.fem import dolfinx_api
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen

SIZES = (0.3, 0.2, 0.15, 0.12, 0.1)
MATERIALS: dict[str, Material] = {"Ogden": Ogden(), "TwoTermI1": TwoTermI1()}
CASES = {"6 x 10": Experiment(), "12 x 10": Experiment(Specimen(12, 10), strains=(0.082, 0.127))}


class NaiveLoop:
    """A simple load loop as a user of dolfinx might write it, for the default loading.

    Strain rises in steps from zero. Newton's method factorises in every iteration, and starts at
    the state before; one more factor at each equilibrium gives the number of negative pivots.
    Bisection between the last stable and the first unstable state gives the critical strain. A push
    along the softest mode, found by inverse iteration, and five steps lead to the last strain on
    the branch. MUMPS keeps its analysis. The loop uses no rates, modes or interpolation, and
    neither follows the unstable path nor computes eigenvalues.
    """

    increment, tolerance = 0.01, 1e-7  # of strain
    push, small = 0.15, 1e-9  # mm; N/mm

    def __init__(self, experiment: Experiment) -> None:
        spec = experiment.specimen
        domain = dolfinx_api.create_mesh(mesh_specimen(spec, experiment.mesh_size), MPI.COMM_SELF)
        V = dolfinx.fem.functionspace(domain, ("Lagrange", 2, (2,)))
        self.u, self.change = dolfinx.fem.Function(V), dolfinx.fem.Function(V)
        self.factorisations = 0
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2})
        energy = experiment.material.energy(ufl.Identity(2) + ufl.grad(self.u)) * dx
        forces = ufl.derivative(energy, self.u, ufl.TestFunction(V))
        self.energy = dolfinx.fem.form(energy)
        self.forces = dolfinx.fem.form(forces)
        self.lifting = dolfinx.fem.form(ufl.derivative(forces, self.u, self.change))
        self.stiffness = dolfinx.fem.form(ufl.derivative(forces, self.u, ufl.TrialFunction(V)))
        x = V.tabulate_dof_coordinates()
        ends = np.flatnonzero(np.abs(np.abs(x[:, 0]) - spec.half_size[0]) < 1e-9)
        self.ends = np.concatenate([2 * ends, 2 * ends + 1])
        self.pushed = -0.5 * spec.length * np.sign(x[ends, 0])
        zero = np.zeros(2)
        self.bcs = [dolfinx.fem.dirichletbc(zero, ends.astype(np.int32), V)]
        self.K = dolfinx.fem.petsc.create_matrix(self.stiffness)
        self.b, self.step = self.K.createVecRight(), self.K.createVecRight()
        self.pc = PETSc.PC().create(MPI.COMM_SELF)
        self.pc.setOperators(self.K)
        self.pc.setType("cholesky")
        self.pc.setFactorSolverType("mumps")
        self.pc.setFactorSetUpSolverType()
        self.factor = self.pc.getFactorMatrix()
        for option, value in ((13, 1), (24, 1), (14, 60)):
            self.factor.setMumpsIcntl(option, value)

    def run(self, strains: tuple[float, ...]) -> tuple[float, float]:
        """The critical strain, and the energy [N] on the branch at the last strain."""
        low, stable, step = 0.0, self.u.x.array.copy(), self.increment
        high = None
        while high is None:
            strain = min([low + step, *(e for e in strains if low < e < low + step)])
            if self.equilibrium(strain) > 0:
                high = strain
            else:
                low, stable = strain, self.u.x.array.copy()
        while high - low > self.tolerance:
            self.u.x.array[:] = stable
            middle = 0.5 * (low + high)
            if self.equilibrium(middle) > 0:
                high = middle
            else:
                low, stable = middle, self.u.x.array.copy()
        self.u.x.array[:] = stable + self.push * self.softest()
        for share in (0.064, 0.16, 0.4, 0.7, 1.0):  # the amplitude grows as their root
            self.equilibrium(low + share * (strains[-1] - low))
        return 0.5 * (low + high), float(dolfinx.fem.assemble_scalar(self.energy))

    def equilibrium(self, strain: float) -> int:
        """Find equilibrium at a strain by Newton's method; returns the negative pivots there."""
        values, change = self.u.x.array, self.change.x.array
        change[self.ends] = np.concatenate([strain * self.pushed, 0.0 * self.pushed])
        change[self.ends] -= values[self.ends]
        self.newton_step(self.lifting)
        values += change
        for _ in range(30):
            if self.newton_step() < self.small:
                return int(self.factor.getInertia()[0])
        raise ArithmeticError(f"no equilibrium at a strain of {strain}")

    def newton_step(self, lifting: Any = None) -> float:
        """Assemble, factorise, solve; returns the norm of the residual before the step."""
        dolfinx_api.assemble_vector(self.forces, self.b)
        if lifting is not None:  # forces by the motion of the ends
            dolfinx_api.assemble_vector(lifting, self.step)
            self.b.axpy(1.0, self.step)
        self.b.array[self.ends] = 0.0
        size = float(self.b.norm())
        self.factorise()
        self.factor.solve(self.b, self.step)
        self.u.x.array[:] -= self.step.array
        return size

    def factorise(self) -> None:
        """Assemble and factorise the tangent; the ordering is that of the first time."""
        dolfinx_api.assemble_matrix(self.stiffness, self.bcs, 1.0, self.K)
        self.K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.pc.setUp()
        self.factorisations += 1

    def softest(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Mode of the eigenvalue nearest to zero, by inverse iteration; largest component 1."""
        mode = self.b.duplicate()
        mode.array[:] = np.random.default_rng(1).normal(size=len(mode.array))
        mode.array[self.ends] = 0.0
        for _ in range(5):
            self.factor.solve(mode.copy(), mode)
            mode.scale(1.0 / mode.norm())
        return np.asarray(mode.array / np.abs(mode.array).max())


def processor(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of some work, and its processor time [s]."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def compare(name: str, experiment: Experiment) -> str:
    """One row of the table: both methods on one case, with forms compiled beforehand."""
    NaiveLoop(experiment)
    solution, ours = processor(lambda: simulate(experiment))

    def naively() -> tuple[NaiveLoop, float, float]:
        loop = NaiveLoop(experiment)
        return loop, *loop.run(experiment.strains)

    (loop, strain, energy), naive = processor(naively)
    critical, count = solution.info["critical"], solution.info["factorisations"]
    proof = f"{critical['negative_pivots_below']} → {critical['negative_pivots_above']}"
    return (
        f"| {name} | {solution.info['unknowns']} | {100 * critical['strain']:.6f}, {proof} "
        f"| {100 * strain:.6f} | {critical['strain'] - strain:+.0e} "
        f"| {solution.snapshots[-1].energy / energy - 1:+.0e} "
        f"| {count} | {loop.factorisations} | {ours:.1f} | {naive:.1f} | {ours / naive:.2f} |"
    )


def row(name: str, material: Material, size: float) -> str:
    """One row of the table of mesh convergence: the 6 x 10 specimen, up to its second snapshot."""
    solution, seconds = processor(lambda: simulate(Experiment(material=material, mesh_size=size)))
    info = solution.info
    critical = info["critical"]
    strain = "none" if critical is None else f"{100 * critical['strain']:.4f}"
    energy = solution.snapshots[-1].energy
    cost = f"{info['factorisations']} | {seconds:.1f}"
    line = f"| {name} | {size:g} | {info['unknowns']} | {strain} | {energy:.5f} | {cost} |"
    return line if info["outcome"] == "complete" else f"{line} {info['outcome']}"


def wall(ranks: int, size: float) -> tuple[float, str]:
    """Wall-clock time of ``simulate`` on some ranks, without their start [s]; critical strain."""
    command = ["mpirun", "-n", str(ranks), sys.executable, __file__, "--one", str(size)]
    message = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return float(message[0]), message[1]


def one(size: float) -> None:
    """Simulate the default experiment on all ranks; print seconds and critical strain."""
    MPI.COMM_WORLD.barrier()
    start = time.perf_counter()
    solution: Solution = simulate(Experiment(mesh_size=size))
    if MPI.COMM_WORLD.rank == 0:
        print(time.perf_counter() - start, solution.info["critical"]["strain"])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--table", action="store_true", help="mesh convergence and cost")
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES, help="mesh sizes [mm]")
    parser.add_argument("--materials", nargs="+", choices=MATERIALS, default=list(MATERIALS))
    parser.add_argument("--ranks", type=float, metavar="SIZE", help="two ranks against one")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        one(arguments.one)
    elif arguments.ranks:
        (alone, strain), (both, same) = (wall(n, arguments.ranks) for n in (1, 2))
        print(f"one rank {alone:.1f} s, two {both:.1f} s: {alone / both:.2f} times faster")
        print(f"critical strains {strain}, {same}")
    elif arguments.table:
        print(
            "| material | h [mm] | unknowns | critical strain [%] | energy at 12.8 % [N] "
            "| factorisations | processor seconds |\n|---|---|---|---|---|---|---|",
            flush=True,
        )
        for name in arguments.materials:
            for size in arguments.sizes:
                print(row(name, MATERIALS[name], size), flush=True)
    else:
        print(
            "| specimen | unknowns | critical strain [%], negative pivots | naive [%] | difference "
            "| relative difference of energy | factorisations | naive | seconds | naive | ratio |"
            "\n|---|---|---|---|---|---|---|---|---|---|---|",
            flush=True,
        )
        for name in arguments.cases:
            print(compare(name, CASES[name]), flush=True)


if __name__ == "__main__":
    main()
