"""The instrument and its world: functions on arrays that know no file and no campaign.

SI units and radians throughout. Frames, axes and signs are those of docs/campaign-format.md.
"""

__version__ = "0.1.0"
