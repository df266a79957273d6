"""The ladder of image registration, as tracks: phase, registration, hybrid.

Functions
---------
run         tracks of the three methods
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.records import CameraPoses, Frames, Tracks
from stages.registration.flattening import flattened
from stages.registration.hybrid import hybrid_motion
from stages.registration.keyframes import follow, similarity_motion
from stages.registration.motion import Motion, carry
from stages.registration.phase import phase_motion
from stages.registration.refinement import patch, refine
from stages.registration.settings import RegistrationSettings
from tsmftis.camera import Camera
from tsmftis.effects import refuse_others

Array = NDArray[np.float64]

ARM = np.array(
    [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]
)  # px: three points whose motion tells how a target's surroundings turn


def run(
    frames: Frames,
    anchored: Tracks,
    nominal: Tracks,
    poses: CameraPoses,
    camera: Camera,
    settings: RegistrationSettings,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> Tracks:
    """Tracks of `phase`, `registration` and `hybrid`: each target's points placed where `anchored` has them in its anchor frame
    (the one in which the target is nearest to mid-detector), then carried by the images.

    phase          translation by phase correlation, images alone
    registration   similarity by corners (KLT, RANSAC), refined about each target by ECC; images alone
    hybrid         rotation by `poses`, translation by the same corners, refined in the same way

    anchored, nominal: tracks by POS and by uniform straight motion, one method each (1, target, point, frame). Frames that the
    images cannot follow end a track (NaN) and are counted in the notes; so are frames that ECC could not refine. `effects` of the
    stage geometry are what a model update adds to the camera.
    """
    refuse_others(effects or {}, "geometry")
    camera = camera.with_effects(effects or {})
    images = flattened(frames, settings)
    links = follow(images, nominal_step(nominal), camera, settings)
    place = np.stack([anchored.col[0], anchored.row[0]], -1)  # (target, point, frame, 2)
    anchor = camera.central_frame(anchored.row[0, :, Tracks.CENTRE], anchored.col[0, :, Tracks.CENTRE])
    start = place[np.arange(anchor.size), :, anchor]
    motions = {
        "phase": phase_motion(images, settings),
        "registration": similarity_motion(links),
        "hybrid": hybrid_motion(links, poses, camera),
    }
    tracks, notes = {}, {}
    for method, motion in motions.items():
        notes[method] = motion.note
        tracks[method] = np.stack([carry(motion, camera, p, f) for p, f in zip(start, anchor, strict=True)])
        if method != "phase":
            tries, kept = 0, 0
            for target, frame in enumerate(anchor):
                shift, tried, unrefined = _corrections(images, motion, start[target], int(frame), camera, settings)
                tracks[method][target] += shift[:, None]
                tries, kept = tries + tried, kept + unrefined
            notes[method] += f", ECC refined {tries - kept} of {tries}"
    found = np.moveaxis(np.stack(list(tracks.values())), 2, 3)  # (method, target, point, frame, 2)
    return Tracks(tuple(motions), anchored.targets, found[..., 1], found[..., 0], notes)


def nominal_step(nominal: Tracks) -> Array:
    """Mean motion (frame, 2) [px] of the targets since the frame before, column first; 0 where no target has one."""
    step = np.zeros((nominal.col.shape[-1], 2))
    for axis, values in enumerate((nominal.col, nominal.row)):
        moves = np.diff(values[0, :, Tracks.CENTRE], axis=-1)
        known = np.isfinite(moves)
        step[1:, axis] = np.where(known, moves, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return step


def _corrections(
    images: NDArray[np.uint8],
    motion: Motion,
    points: Array,
    anchor: int,
    camera: Camera,
    settings: RegistrationSettings,
) -> tuple[Array, int, int]:
    """What a target's track lacks in each frame (frame, 2) [px], in how many frames ECC was tried, and how many it left.

    Where it fails, and beyond the detector, the correction is that of the frames about.
    """
    centre = points[Tracks.CENTRE]
    origin, *arms = np.moveaxis(carry(motion, camera, centre + ARM, anchor), 1, 0)
    turn = np.stack([(arm - origin) / ARM.max() for arm in arms], -1)  # (frame, 2, 2), by column
    on = ((origin > -0.5) & (origin < [camera.cols - 0.5, camera.rows - 0.5])).all(axis=1)
    target = patch(images[anchor], centre, settings)
    lacks = {
        int(i): None if target is None else refine(target, images[i], origin[i], turn[i], settings)
        for i in np.flatnonzero(on)
    }
    found = {i: value for i, value in lacks.items() if value is not None}
    shift = np.zeros_like(origin)
    if found:
        for axis in range(2):
            shift[:, axis] = np.interp(np.arange(len(origin)), list(found), [v[axis] for v in found.values()])
    return shift, len(lacks), len(lacks) - len(found)
