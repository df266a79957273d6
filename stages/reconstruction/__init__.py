"""Reconstruction: frames and tracks in, interferograms and spectra out; and what the closed loop is offered of them."""

from stages.reconstruction.residual import SpectralLine, residual_problem
from stages.reconstruction.spectra import ReconstructionResult, ReconstructionSettings, run

__all__ = ["ReconstructionResult", "ReconstructionSettings", "SpectralLine", "residual_problem", "run"]
