"""Simulation: settings and a seed in, a complete campaign with its truth out.

settings = SimulationSettings.preset("demo")
campaign = run(settings, seed=1)
write(campaign, Path("out/demo"))            # and out/demo-truth beside it
"""

from stages.simulation.files import write
from stages.simulation.records import SimulatedCampaign
from stages.simulation.settings import SimulationSettings
from stages.simulation.simulate import run

__all__ = ["SimulatedCampaign", "SimulationSettings", "run", "write"]
