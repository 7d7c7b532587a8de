"""Coverage of the twin's 95 % intervals over many seeds of the camera's noise.

Needs the twin's photographs and harvest (minutes), which it makes in out/twin unless they are
there: modeharvest run paper-real-twin --out out/twin. Goes on where it was stopped.

Run: scripts/env python benchmarks/twin_coverage.py [--seeds 100] [--workers 2] [--folder out/twin]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from modeharvest.runs.case import TwinCase, read_case, shipped_solution
from modeharvest.runs.twin import TwinRun
from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import Workers

FUNCTION = "modeharvest.runs.twin:one_seed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out/twin"))
    parser.add_argument("--name", default="deformed_1270")
    options = parser.parse_args()
    case = read_case("paper-real-twin")
    assert isinstance(case, TwinCase), "the shipped twin"
    TwinRun(case, options.folder, solution=shipped_solution("paper-real-twin")).all()
    cases = grid({"name": options.name, "seed": 0}, seed=range(options.seeds))
    campaign = Campaign(FUNCTION, cases, options.folder.resolve())
    table = campaign.run(Workers(options.workers), lambda d, n, what: print(f"{d}/{n}", end="\r"))
    failed = int((table["error"] != "").sum())
    print(f"{len(table)} seeds of noise, {failed} failed; {options.name}")
    print(f"{'field':10}{'covered by 95 % intervals':>28}{'rms deviation / its sd':>26}")
    for field in ("v0", "v1", "v1phi1"):
        covered, deviation = table[f"covered {field}"].mean(), table[f"deviation {field}"]
        print(f"{field:10}{100 * covered:26.1f} %{(deviation**2).mean() ** 0.5:26.3f}")


if __name__ == "__main__":
    main()
