"""Reconstruction: frames and tracks in, interferograms and spectra out."""

from stages.reconstruction.spectra import ReconstructionResult, ReconstructionSettings, run

__all__ = ["ReconstructionResult", "ReconstructionSettings", "run"]
