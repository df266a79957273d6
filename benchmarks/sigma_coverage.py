"""Whether sigma_radiance is honest: how many of the true radiances lie within the 95 % intervals of spectra.nc.

    python benchmarks/sigma_coverage.py [--campaigns 14] [--first-seed 100]

Each campaign is the preset `demo` with four lines of nine panels, simulated, written and run from its files as a user's
would be (tracking by the POS, nothing handed over). Printed for one point and for the area: spectra, coverage over all their
wavenumbers, the spread of (B − B_ref)/sigma, and over how much the share of a single spectrum scatters.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from flows.campaign import run_campaign
from flows.steps import Plan
from stages import simulation

PANELS = ("white", "red", "green", "grey", "blue", "black", "holmium", "grey", "white")
STARTS = (42.0, 62.0, 172.0, 184.0)


def spectra(seed: int, folder: Path) -> dict[str, list[np.ndarray]]:
    """(B − B_ref)/sigma (wavenumber,) of each scored spectrum under `tracking`."""
    preset = simulation.SimulationSettings.preset("demo").model_dump()
    preset["lines"] = [
        {"id": f"L{i}", "start_s": start, "duration_s": 6.5, "panels": list(PANELS)}
        for i, start in enumerate(STARTS, start=1)
    ]
    campaign = simulation.run(simulation.SimulationSettings.model_validate(preset), seed)
    simulation.write(campaign, folder / "campaign")
    for record in run_campaign(Plan(folder / "campaign", folder / "out")):
        if record.status != "done":
            raise SystemExit(f"{record.stage} {record.unit}: {record.problem}")
    out: dict[str, list[np.ndarray]] = {"radiance": [], "radiance_area": []}
    for path in sorted((folder / "out").glob("F1/L*/spectra.nc")):
        with xr.open_dataset(path) as d:
            found = d.sel({"method": "tracking"})
            for name, kept in out.items():
                z = ((found[name] - found.reference) / found[f"sigma_{name}"]).values
                kept.extend(row for row in z if np.isfinite(row).all())
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=14)
    parser.add_argument("--first-seed", type=int, default=100)
    a = parser.parse_args()
    every: dict[str, list[np.ndarray]] = {"radiance": [], "radiance_area": []}
    for seed in range(a.first_seed, a.first_seed + a.campaigns):
        with tempfile.TemporaryDirectory() as folder:
            for name, found in spectra(seed, Path(folder)).items():
                every[name].extend(found)
        print(f"seed {seed}: {len(every['radiance'])} spectra so far", flush=True)
    for name, found in every.items():
        z = np.stack(found)
        share = (np.abs(z) <= 1.96).mean(axis=1)
        print(
            f"{name}: {len(z)} spectra of {z.shape[1]} wavenumbers: {100 * share.mean():.1f} % "
            f"(± {100 * share.std() / np.sqrt(len(z)):.1f}) within 1.96 sigma; "
            f"rms of (B − B_ref)/sigma {np.sqrt((z**2).mean()):.2f}; quartiles of a spectrum's share "
            f"{np.percentile(100 * share, 25):.0f}, {np.percentile(100 * share, 75):.0f} %"
        )


if __name__ == "__main__":
    main()
