"""Other people's file formats, to records and back: `sbet` (trajectories), `opus` (laboratory interferograms)."""
