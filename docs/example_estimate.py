"""The estimators as a library: a path and an elevation map from frames in memory; no simulator is loaded.

The frames are windows of one random texture: a stereo pair moves 0.8 m over a flat floor at 2 m distance.
"""

import cv2
import numpy as np

from twin.estimate import EstimatorSettings, Frame, Navigator, StereoRig

RIG = StereoRig(width_px=320, height_px=240, focal_px=280.0, baseline_m=0.15, frame_rate_hz=15.0)
DEPTH_M, SPEED_MPS, N_FRAMES = 2.0, 0.2, 60
PIXEL_M = DEPTH_M / RIG.focal_px

rng = np.random.default_rng(1)
octaves = [rng.normal(size=(96 * scale, 96 * scale)) for scale in (1, 2, 4, 8)]
noise = sum(cv2.resize(octave, (1536, 1536), interpolation=cv2.INTER_CUBIC) for octave in octaves)
floor = np.clip(128 + 25 * noise, 0, 255).astype(np.float32)


def image(x_m: float) -> np.ndarray:
    """Returns the RGB image (H, W, 3) of a camera at (x_m, 0, 0) that looks straight down on the floor."""
    centre = 500 + x_m / PIXEL_M, 768.0
    gray = cv2.getRectSubPix(floor, (RIG.width_px, RIG.height_px), centre)
    gray = gray + rng.normal(0, 2, gray.shape)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


with Navigator(RIG, EstimatorSettings(keyframe_overlap=0.9), start=np.diag([1.0, -1.0, -1.0, 1.0])) as navigator:
    for k in range(N_FRAMES):
        x_m = SPEED_MPS * k / RIG.frame_rate_hz
        navigator.update(Frame(k, k / RIG.frame_rate_hz, image(x_m), image(x_m + RIG.baseline_m)))
    result = navigator.finish()
    elevation = navigator.build_map(result)

travelled_m = SPEED_MPS * (N_FRAMES - 1) / RIG.frame_rate_hz
error_m = np.linalg.norm(result.final.positions[-1] - [travelled_m, 0, 0])
assert elevation is not None
height_m = elevation.height_m[np.isfinite(elevation.height_m)]
print(f"{len(result.keyframe_rows)} keyframes, {len(result.links)} links")
print(f"position error after {travelled_m:.2f} m: {1000 * error_m:.1f} mm")
print(f"map of {height_m.size} cells, median height {np.median(height_m):.3f} m")
assert error_m < 0.005 and abs(np.median(height_m) + DEPTH_M) < 0.005
