"""Registration of a textured ground seen under fixed fringes, moved by a known similarity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from pipeline.records import Frames, Tracks
from stages.registration import RegistrationSettings, run
from tsmftis.camera import Camera

ROWS, COLS, FRAMES = 96, 192, 90
CAMERA = Camera(ROWS, COLS, 15e-6, 0.07, 47.5, 95.5, 100.0, 16383.0)


def motion(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row offset [px] and rotation [rad] about mid-detector of the scene in each frame."""
    return 0.8 * frame + 1.5 * np.sin(frame / 6.0), 3.0 * np.sin(frame / 9.0), 0.004 * np.sin(frame / 11.0)


def where(row: np.ndarray, col: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Detector position in a frame of the scene point that lies at row, col of the scene's own grid."""
    dc, dr, angle = motion(frame)
    x, y = col - 95.5, row - 47.5
    c, s = np.cos(angle), np.sin(angle)
    return 47.5 + s * x + c * y + dr, 95.5 + c * x - s * y + dc


def frames(blank: slice | None = None) -> Frames:
    """Texture moved by the inverse of `where`, times fringes fixed to the columns and a flat, with read noise of 5 DN."""
    rng = np.random.default_rng(1)
    scene = 1.0 + 0.25 * gaussian_filter(rng.standard_normal((160, 420)), 1.5) / 0.19
    rows, cols = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
    fringes = 1.0 + 0.6 * np.exp(-(((cols - 28) / 40.0) ** 2)) * np.cos(2 * np.pi * cols / 2.9)
    flat = rng.uniform(0.97, 1.03, (ROWS, COLS))
    counts = np.empty((FRAMES, ROWS, COLS), np.uint16)
    for i in range(FRAMES):
        dc, dr, angle = motion(np.array(float(i)))
        x, y = cols - 95.5 - dc, rows - 47.5 - dr
        c, s = np.cos(angle), np.sin(angle)
        image = map_coordinates(scene, [c * y - s * x + 47.5 + 32, c * x + s * y + 95.5 + 130], order=3, mode="reflect")
        if blank is not None and i in range(*blank.indices(FRAMES)):
            image = np.ones_like(image)
        counts[i] = np.clip(3000.0 * image * fringes * flat + 5.0 * rng.standard_normal(image.shape), 0, 16000)
    return Frames(np.arange(FRAMES) * 0.01, counts)


def anchored() -> Tracks:
    """Two targets, where POS would have them: exactly right."""
    frame = np.arange(FRAMES, dtype=float)
    grid = np.stack(np.meshgrid(np.linspace(-4, 4, 5), np.linspace(-4, 4, 5), indexing="ij"), -1).reshape(25, 2)
    rows, cols = [], []
    for row, col in ((40.0, 60.0), (58.0, 85.0)):
        r, c = where(row + grid[:, :1], col + grid[:, 1:], frame)
        rows.append(r)
        cols.append(c)
    return Tracks(("tracking",), ("a", "b"), np.stack(rows)[None], np.stack(cols)[None])


def test_known_motion_is_recovered_under_fixed_fringes() -> None:
    """0.1 px RMS while the target is on the detector (the anchors table has key-frame KLT at 0.03 px over 48 frames);
    unflattened fringes would pull it by pixels."""
    true = anchored()
    found = run(frames(), true, CAMERA, RegistrationSettings())
    assert found.methods == ("registration",)
    on = (true.col > 0) & (true.col < COLS - 1)
    error = np.hypot(found.row - true.row, found.col - true.col)
    print("registration", np.sqrt(np.mean(error[on] ** 2)), error[on].max(), found.notes)
    assert np.sqrt(np.mean(error[on] ** 2)) < 0.1
    assert ", 0 breaks" in found.notes["registration"]


def test_a_break_ends_the_tracks_and_is_counted() -> None:
    """Four frames without texture: nothing beyond them is followed from the anchor's side, and the note counts breaks."""
    true = anchored()
    anchor = CAMERA.central_frame(true.row[0, :, 12], true.col[0, :, 12])
    start = int(anchor.max()) + 12
    found = run(frames(slice(start, start + 4)), true, CAMERA, RegistrationSettings())
    print(anchor, start, found.notes)
    assert np.isnan(found.col[0, :, :, start + 4 :]).all()
    before = slice(int(anchor.min()), start - 1)
    assert np.abs(found.col - true.col)[0, :, :, before].max() < 0.3
    assert ", 0 breaks" not in found.notes["registration"]


def test_frames_without_texture_are_all_breaks_not_an_error() -> None:
    counts = np.full((20, ROWS, COLS), 3000, np.uint16)
    short = Tracks(("tracking",), ("a", "b"), anchored().row[..., :20], anchored().col[..., :20])
    found = run(Frames(np.arange(20) * 0.01, counts), short, CAMERA, RegistrationSettings())
    assert "19 breaks" in found.notes["registration"]
    assert np.isfinite(found.col).any(axis=-1).all()  # the anchor itself stays
    assert pytest.approx(1) == np.isfinite(found.col[0, 0, 12]).sum()
