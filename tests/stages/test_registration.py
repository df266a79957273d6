"""Registration of a textured ground seen under fixed fringes by a camera that flies, turns and shakes.

The scene is rendered here with numpy and scipy alone: rays of the pin-hole (with radial distortion where asked for), turned by
scipy's rotations, met with the ground; true tracks are the same geometry the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from pipeline.records import CameraPoses, Frames, Tracks
from stages.registration import RegistrationSettings, image_motion, run
from tsmftis.camera import Camera

ROWS, COLS, FRAMES = 96, 192, 90
HEIGHT, SAMPLE = 2000.0, 2000.0 * 15e-6 / 0.07  # m above the ground, m a pixel
NED_TO_ECEF = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # at latitude 0, longitude 0
METHODS = ("phase", "registration", "hybrid")
TARGETS = ((-6.0, 8.0), (5.0, -4.0))  # m north and east of where the camera is at mid-line
K1 = 20.0  # 0.8 px at the ends of the detector


@dataclass(frozen=True)
class Flight:
    """What a scene has of turning [rad, amplitude], relief [m, hills 15 m wide on the targets] and distortion."""

    roll: float = 3.0 / 4667
    pitch: float = 1.5 / 4667
    yaw: float = 0.004
    relief: float = 0.0
    k1: float = 0.0

    @property
    def camera(self) -> Camera:
        return Camera(ROWS, COLS, 15e-6, 0.07, 47.5, 95.5, 100.0, 16383.0, radial_k1=self.k1)

    def pose(self, frame: float) -> tuple[np.ndarray, Rotation]:
        """Camera in metres north, east, down of the ground at mid-line, and its rotation to these axes."""
        along = 0.8 * SAMPLE * (frame - FRAMES / 2)
        angles = [self.yaw * np.sin(frame / 11), self.pitch * np.sin(frame / 6), self.roll * np.sin(frame / 9)]
        return np.array([along, 0.0, -HEIGHT]), Rotation.from_euler("ZYX", angles)

    def ground(self, north: np.ndarray, east: np.ndarray) -> np.ndarray:
        """Height of the ground [m]."""
        if not self.relief:
            return np.zeros_like(north)
        hills = [np.exp(-((north - n) ** 2 + (east - e) ** 2) / (2 * 15.0**2)) for n, e in TARGETS]
        return self.relief * np.sum(hills, axis=0)

    def project(self, north: np.ndarray, east: np.ndarray, frame: float) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of ground points."""
        centre, turned = self.pose(frame)
        points = np.stack([north, east, -self.ground(north, east)], -1) - centre
        x, y, z = np.moveaxis(turned.inv().apply(points.reshape(-1, 3)).reshape(points.shape), -1, 0)
        stretch = 4666.6667 * (1 + self.k1 * ((x / z) ** 2 + (y / z) ** 2))
        return 47.5 + stretch * y / z, 95.5 - stretch * x / z

    def meets(self, frame: float) -> tuple[np.ndarray, np.ndarray]:
        """Where on the ground each pixel looks, north and east (row, col) [m]."""
        rows, cols = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
        u, v = (95.5 - cols) / 4666.6667, (rows - 47.5) / 4666.6667
        x, y = u, v
        for _ in range(6):
            stretch = 1 + self.k1 * (x * x + y * y)
            x, y = u / stretch, v / stretch
        centre, turned = self.pose(frame)
        rays = turned.apply(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)).reshape(ROWS, COLS, 3)
        height = np.zeros((ROWS, COLS))
        for _ in range(6 if self.relief else 1):
            north, east = (centre[i] + rays[..., i] / rays[..., 2] * (HEIGHT - height) for i in range(2))
            height = self.ground(north, east)
        return north, east


@cache
def frames(flight: Flight, blank: tuple[int, int] = (0, 0)) -> Frames:
    """Texture times fringes fixed to the columns and a flat, with read noise of 5 DN; no texture in frames `blank`."""
    rng = np.random.default_rng(1)
    scene = spline_filter(1.0 + 0.25 * gaussian_filter(rng.standard_normal((240, 420)), 1.5) / 0.19)
    fringes = 1.0 + 0.6 * np.exp(-(((np.arange(COLS) - 28) / 40.0) ** 2)) * np.cos(2 * np.pi * np.arange(COLS) / 2.9)
    flat = rng.uniform(0.97, 1.03, (ROWS, COLS))
    counts = np.empty((FRAMES, ROWS, COLS), np.uint16)
    for i in range(FRAMES):
        image = np.ones((ROWS, COLS))
        if not blank[0] <= i < blank[1]:
            north, east = flight.meets(i)
            image = map_coordinates(scene, [east / SAMPLE + 120, north / SAMPLE + 210], mode="mirror", prefilter=False)
        counts[i] = np.clip(3000.0 * image * fringes * flat + 5.0 * rng.standard_normal(image.shape), 0, 16000)
    return Frames(np.arange(FRAMES) * 0.01, counts)


def true_tracks(flight: Flight) -> Tracks:
    """Two targets and the points about them, where POS would have them: exactly right."""
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 5), np.linspace(-1.5, 1.5, 5), indexing="ij"), -1).reshape(25, 2)
    points = np.array(TARGETS)[:, None] + grid
    where = [flight.project(points[..., 0], points[..., 1], i) for i in range(FRAMES)]
    return Tracks(
        ("tracking",),
        ("a", "b"),
        np.stack([row for row, _ in where], -1)[None],
        np.stack([col for _, col in where], -1)[None],
    )


def nominal(true: Tracks) -> Tracks:
    """Uniform motion of 0.8 pixels a frame along the columns."""
    along = np.broadcast_to(0.8 * np.arange(true.col.shape[-1]), true.col.shape)
    return replace(true, methods=("nominal",), row=np.zeros_like(true.row), col=along)


def poses(flight: Flight) -> CameraPoses:
    known = [flight.pose(i) for i in range(FRAMES)]
    centre = np.array([6378137.0, 0.0, 0.0]) + np.array([c for c, _ in known]) @ NED_TO_ECEF.T
    dcm = NED_TO_ECEF @ np.array([turned.as_matrix() for _, turned in known])
    return CameraPoses(np.arange(FRAMES) * 0.01, centre, dcm)


def followed(
    flight: Flight,
    blank: tuple[int, int] = (0, 0),
    settings: RegistrationSettings | None = None,
    camera: Camera | None = None,
) -> tuple[Tracks, Tracks, dict[str, float]]:
    """Tracks found, true tracks, and the RMS [px] of each method where the targets are on the detector."""
    true = true_tracks(flight)
    found = run(
        frames(flight, blank),
        true,
        nominal(true),
        poses(flight),
        camera or flight.camera,
        settings or RegistrationSettings(),
    )
    on = (true.col[0] > 0) & (true.col[0] < COLS - 1) & (true.row[0] > 0) & (true.row[0] < ROWS - 1)
    assert on.mean() > 0.95
    error = np.hypot(found.row - true.row, found.col - true.col)
    rms = {m: float(np.sqrt(np.nanmean(error[i][on] ** 2))) for i, m in enumerate(found.methods)}
    print(rms, {m: float(np.nanmax(error[i][on])) for i, m in enumerate(found.methods)}, found.notes)
    return found, true, rms


def test_known_motion_is_recovered_under_fixed_fringes() -> None:
    """0.08 px RMS with corners and ECC: the median of so few frames keeps a faint print of the scene, which pulls towards no
    motion. Phase correlation knows no yaw (0.004 rad at 40 px from the centre are 0.16 px) and its peak is good to a tenth
    of a pixel. Unflattened fringes would pull each by pixels."""
    found, _, rms = followed(Flight())
    assert found.methods == METHODS
    assert rms["registration"] < 0.08
    assert rms["hybrid"] < 0.08
    assert rms["phase"] < 0.4
    assert all(", 0 breaks" in note for note in found.notes.values())


def test_rotation_by_pos_beats_phase_correlation_when_the_camera_turns() -> None:
    """Yaw of 1.1° and roll of 20 pixels: translation alone is wrong by a pixel where the target is off the centre."""
    _, _, rms = followed(Flight(roll=20.0 / 4667, yaw=0.02))
    assert rms["hybrid"] < 0.08
    assert rms["registration"] < 0.08
    assert rms["phase"] > 5 * rms["hybrid"]


def test_a_target_on_a_hill_moves_by_its_own_parallax() -> None:
    """40 m of 2000 m are 2 % of 40 px: 0.8 px where one motion for the whole frame has to serve, and phase correlation has no
    other; ECC about the target (20 px, over which the hill falls by an eighth) finds it to a fraction."""
    _, _, rms = followed(Flight(relief=40.0))
    assert rms["phase"] > 0.3
    assert rms["registration"] < 0.12
    assert rms["hybrid"] < 0.12


def test_radial_distortion_is_taken_off() -> None:
    """0.8 px at the ends of the detector, which a similarity between pixels as measured has to average. Corners alone, since ECC
    would find much of it again."""
    corners = RegistrationSettings(ecc_reach_px=0.001)
    _, _, rms = followed(Flight(k1=K1), settings=corners)
    _, _, ignored = followed(Flight(k1=K1), settings=corners, camera=Flight().camera)
    for method in ("registration", "hybrid"):
        assert rms[method] < 0.06
        assert ignored[method] > 1.5 * rms[method]


def test_a_break_ends_the_tracks_and_is_counted() -> None:
    """Four frames without texture: nothing beyond them is followed from the anchor's side, and the notes count breaks."""
    true = true_tracks(Flight())
    anchor = Flight().camera.central_frame(true.row[0, :, Tracks.CENTRE], true.col[0, :, Tracks.CENTRE])
    start = int(anchor.max()) + 8
    assert start + 4 < FRAMES - 3
    found, true, _ = followed(Flight(), (start, start + 4))
    for method, col, true_col in zip(METHODS, found.col, np.broadcast_to(true.col, found.col.shape), strict=True):
        assert np.isnan(col[..., start + 4 :]).all(), method
        assert np.isfinite(col[..., :start]).all(), method
        assert np.abs(col - true_col)[..., :start].max() < (1.0 if method == "phase" else 0.2)
        assert ", 0 breaks" not in found.notes[method]


def test_frames_without_texture_are_all_breaks_not_an_error() -> None:
    counts = np.full((20, ROWS, COLS), 3000, np.uint16)
    true, known = true_tracks(Flight()), poses(Flight())
    short = replace(true, row=true.row[..., :20], col=true.col[..., :20])
    found = run(
        Frames(np.arange(20) * 0.01, counts),
        short,
        nominal(short),
        CameraPoses(known.time[:20], known.centre[:20], known.dcm[:20]),
        Flight().camera,
        RegistrationSettings(),
    )
    for method, col in zip(METHODS, found.col, strict=True):
        assert "19 breaks" in found.notes[method]
        assert np.isfinite(col).any(axis=-1).all()  # the anchor itself stays
        assert pytest.approx(1) == np.isfinite(col[0, 12]).sum()
    assert "ECC refined 0 of 2" in found.notes["registration"]


def test_frames_without_a_pose_end_the_hybrid_alone() -> None:
    flight = Flight()
    true, known = true_tracks(flight), poses(flight)
    dcm = known.dcm.copy()
    dcm[80:] = np.nan
    found = run(frames(flight), true, nominal(true), replace(known, dcm=dcm), flight.camera, RegistrationSettings())
    assert np.isnan(found.col[METHODS.index("hybrid"), ..., 80:]).all()
    assert np.isfinite(found.col[METHODS.index("hybrid"), ..., :80]).all()
    assert np.isfinite(found.col[METHODS.index("registration")]).all()
    assert ", 10 breaks" in found.notes["hybrid"]


def test_a_refinement_that_goes_too_far_leaves_the_corners_estimate_and_is_counted() -> None:
    """With a reach of a thousandth of a pixel hardly a frame is refined, and the corners alone still follow to 0.2 px."""
    found, _, rms = followed(Flight(), settings=RegistrationSettings(ecc_reach_px=0.001))
    refined, tried = (int(v) for v in found.notes["registration"].split("ECC refined ")[1].split(" of "))
    assert refined < 0.1 * tried
    assert rms["registration"] < 0.2


def test_the_same_frames_give_the_same_tracks_on_any_number_of_threads() -> None:
    before, results = cv2.getNumThreads(), []
    try:
        for threads, seed in ((1, 1), (4, 2)):
            cv2.setNumThreads(threads)
            cv2.setRNGSeed(seed)
            results.append(followed(Flight())[0])
    finally:
        cv2.setNumThreads(before)
    for name in ("row", "col"):
        assert getattr(results[0], name).tobytes() == getattr(results[1], name).tobytes()


def test_motion_of_pairs_is_that_of_the_ground() -> None:
    """Mean over a pair within .05 px of the truth, points clear of the edge, under fixed fringes and distortion."""
    flight = Flight(k1=K1)
    found = image_motion(frames(flight), flight.camera, RegistrationSettings())
    assert found.first.size >= 5 and np.unique(found.second - found.first).size == 1
    assert (np.diff(found.pair) >= 0).all() and found.sigma.max() < 0.15
    for i, (first, second) in enumerate(zip(found.first, found.second, strict=True)):
        mine = found.pair == i
        row, col = found.row[mine], found.col[mine]
        assert row.min() >= 15 and col.min() >= 15 and row.max() <= ROWS - 16 and col.max() <= COLS - 16
        where = [np.rint(v).astype(int) for v in (row, col)]
        north, east = (g[where[0], where[1]] for g in flight.meets(float(first)))
        begun = np.stack(flight.project(north, east, float(first)))
        moved = np.stack(flight.project(north, east, float(second))) - begun
        seen = np.stack([found.row_shift[mine], found.col_shift[mine]])
        np.testing.assert_allclose(np.mean(seen - moved, axis=1), 0.0, atol=0.05)


def test_frames_without_texture_have_no_motion() -> None:
    found = image_motion(frames(Flight(), (0, FRAMES)), Flight().camera, RegistrationSettings())
    assert found.first.size == 0 and found.pair.size == 0
