"""What would separate effects that a campaign cannot: a table beside the library of effects.

`would_separate` looks up pairs first, then single effects, and else says what holds for any two.
"""

from __future__ import annotations

from collections.abc import Iterable

PAIRS: dict[frozenset[str], str] = {
    frozenset(pair): text
    for pair, text in (
        (
            ("antenna_lever_arm", "gnss_latency"),
            "turns at several speeds: the latency's error follows speed, the arm's heading",
        ),
        (("focal_length", "radial_distortion"), "control points over the whole image, centre and corners alike"),
        (
            ("boresight", "camera_latency"),
            "lines at different speeds, or in rougher air: the latency's error follows the rates",
        ),
        (("boresight", "boresight_thermal_drift"), "lines at different temperatures"),
        (("boresight", "dem_bias"), "lines in opposite directions, and at two heights"),
        (("focal_length", "dem_bias"), "lines at two heights, or surveyed relief"),
        (("camera_latency", "mount_flexure"), "lines with angular acceleration: turbulence or deliberate rocking"),
        (("accel_scale_factor", "antenna_lever_arm"), "horizontal accelerations of both signs: turns left and right"),
        (
            ("gyro_g_sensitivity", "gyro_scale_factor"),
            "turns and accelerations apart: figures of eight, and fast straight runs",
        ),
        (
            ("thermal_hysteresis", "thermal_lag"),
            "chamber ramps at several rates, with stops: a lag dies out, a play stays",
        ),
        (("opd_scale", "opd_quadratic"), "a line source, or longer optical path differences"),
        (
            ("detector_nonlinearity", "response_scale"),
            "targets of different brightness, or an attenuator of known transmission",
        ),
    )
}
SINGLE: dict[str, str] = {
    "antenna_lever_arm": "turns, and climbs for the vertical part",
    "gnss_latency": "accelerated flight: turns and changes of speed",
    "gyro_scale_factor": "full turns in both directions about that axis",
    "accel_scale_factor": "manoeuvres with vertical and horizontal acceleration",
    "gyro_g_sensitivity": "manoeuvres with changing specific force: coordinated turns, pull-ups",
    "thermal_hysteresis": "a chamber run that heats and cools through the same temperatures",
    "thermal_lag": "chamber ramps at several rates, with stops between",
    "camera_latency": "lines with attitude motion, or at different speeds",
    "boresight": "control points on two lines in opposite directions",
    "boresight_thermal_drift": "lines at different temperatures",
    "mount_flexure": "lines with angular acceleration",
    "focal_length": "control points across the whole swath",
    "radial_distortion": "control points in the corners of the image",
    "dem_bias": "surveyed heights in the scene",
    "opd_scale": "a source with sharp lines",
    "opd_quadratic": "a source with sharp lines, both sides of zero path difference",
    "fringe_tilt": "targets in many rows",
    "detector_nonlinearity": "targets of different brightness",
    "channel_fringe": "a spectrum with less structure of its own, at full resolution",
    "response_scale": "references that were measured independently",
}


def would_separate(effects: Iterable[str]) -> str:
    """The manoeuvre or run that tells the effects apart, or shows the one that is named."""
    names = sorted(set(effects))
    texts = [text for pair, text in PAIRS.items() if pair <= set(names)]
    if not texts:
        texts = [SINGLE[name] for name in names if name in SINGLE]
    if not texts and len(names) == 1:
        return f"a run in which {names[0]} acts more strongly, and unlike what the model takes up anyway"
    if not texts:
        return f"a run in which {' and '.join(names)} act differently from each other"
    return "; ".join(dict.fromkeys(texts))
