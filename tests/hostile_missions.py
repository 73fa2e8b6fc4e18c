"""Hostile and ordinary missions: none may end "complete" with a wrong path, and ordinary ones must not be degraded.

usage: python tests/hostile_missions.py OUT.jsonl [MISSION...|faults] [--seeds 3] [--first 1] [--jobs 2] [--ordinary]

Flies each mission rendered over 2 m x 1 m (one track, two legs) with the seeds from `--first` to `--seeds` and appends
one line per survey to OUT.jsonl; surveys already in the file are not flown again. The table at the end lists each
mission and the wrong ones:

hostile: status "complete" although the largest position error of a frame exceeds 4 times its standard deviation (of
    the worst keyframe and the motion since the last keyframe), the RMS of error / sigma of the map exceeds 4, or less
    than 90 % of the asked area is mapped;
ordinary: status other than "complete".
"""

import argparse
import json
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

import twin
from twin import survey
from twin.errors import TwinError
from twin.world.rendered_world import RenderedWorld

MAX_SIGMAS, MAX_MAP_SIGMAS, MIN_COMPLETENESS, N_ORDINARY = 4.0, 4.0, 0.9, 60
SHORT = ("plan.area_m=[2.0,1.0]", "plan.tracks=1")
#: Faults that no image shows: scaling baseline, path and floor together leaves all images unchanged, and so does, over
#: motions across the optical axis, scaling focal length and depths; equal errors of both principal points shear path
#: and floor alike at a constant heading and height (with turns, the same error is found).
UNOBSERVABLE = (
    "baseline error 5 %", "focal length error 2 %", "focal length error 10 %", "focal error 2 %, waves",
    "both principal points 8 px",
)  # fmt: skip
FLOOR_FILE = ("terrain.kind=file", "terrain.height_file={folder}/floor.npy", "terrain.height_spacing_m=0.04")
CROSS_LINE = ("plan.cross_lines=1", "plan.cross_rise_m=0.6")
ALL_SENSORS = 'navigation.aiding=["pressure","ahrs","dvl","usbl"]'
VISION_ALONE = "navigation.aiding=[]"
SUN = ("lamps=[]", "sun.illuminance_lx=20000", "sun.depth_m=5")


def lamps(intensity_cd):
    """Returns the override for two lamps of the given intensity [cd]."""
    at = "{position_m=[0.25,%s,-0.05],pan_deg=%s,intensity_cd=%s}"
    return f"lamps=[{at % (0.35, -8, intensity_cd)},{at % (-0.35, 8, intensity_cd)}]"


def fault(part, type_, duration_s=None, **keys):
    """Returns the overrides for one fault from 4 s on, with all sensors."""
    keys = {"part": f'"{part}"', "type": f'"{type_}"', "start_s": 4.0, **keys}
    keys |= {} if duration_s is None else {"duration_s": duration_s}
    text = ",".join(f"{key}={value}" for key, value in keys.items() if value is not None)
    return f"faults=[{{{text}}}]", ALL_SENSORS


def principal_points(left_px, right_px):
    """Returns the overrides for errors of both principal points [px]."""
    return tuple(
        f"calibration_error.{side}_principal_point_error_px={error_px}"
        for side, error_px in (("left", left_px), ("right", right_px))
    )


FAULTS = {
    "cameras off for 3 s": fault("cameras", "off", 3),
    "cameras frozen for 3 s": fault("cameras", "stuck", 3),
    "images of noise for 3 s": fault("cameras", "garbage", 3),
    "half of the images lost for 5 s": fault("cameras", "intermittent", 5, size=0.5),
    "left camera off for 5 s": fault("left_camera", "off", 5),
    "right camera off for 5 s": fault("right_camera", "off", 5),
    "right camera frozen for 5 s": fault("right_camera", "stuck", 5),
    "right images of noise for 5 s": fault("right_camera", "garbage", 5),
    "half of the contrast lost in silt": fault("water", "silt", 5),
    "silt-out for 3 s": fault("water", "silt", 3, size=1.0),
    "8 fish": fault("fish", "school", 10, size=8),
    "one lamp off": fault("lamp", "off", number=1),
    "lamps off for 3 s": fault("lamp", "off", 3),
    "lamps off at a place": fault("lamp", "off", 2, start_s=None, at_m=[0.3, -0.4], radius_m=0.3),
    "lamps that flicker": fault("lamp", "intermittent", 5, size=0.3),
    "gust of 0.4 m/s": fault("water", "gust", 4, size=0.4),
    "thruster off": fault("thruster", "off", number=1),
    "vertical thruster off": fault("thruster", "off", number=5),
    "thruster at a third": fault("thruster", "wrong", number=1, size=0.3),
    "thruster stuck": fault("thruster", "stuck", number=1),
    "pressure 0.3 m off": fault("pressure", "wrong", 5, size=0.3),
    "AHRS 10 deg off": fault("ahrs", "wrong", 5, size=10),
    "DVL 0.3 m/s off": fault("dvl", "wrong", 5, size=0.3),
    "DVL without bottom lock": fault("dvl", "off", 10),
    "DVL 1 s late": fault("dvl", "delayed", size=1),
    "AHRS 0.5 s late": fault("ahrs", "delayed", size=0.5),
    "pressure 1 s late": fault("pressure", "delayed", size=1),
    "USBL 2 s late": fault("usbl", "delayed", size=2),
    "USBL spikes of 3 m": fault("usbl", "garbage", size=3),
    "USBL 3 m off": fault("usbl", "wrong", size=3),
}
HOSTILE = {
    **FAULTS,
    **{
        f"{water} x{turbidity}": (f"water.jerlov={water}", f"water.turbidity={turbidity}")
        for water, levels in {"5C": (1, 2, 5, 10), "7C": (1, 2, 5), "9C": (1, 2, 10)}.items()
        for turbidity in levels
    },
    "lamps of 0.01 cd": (lamps(0.01),),
    "lamps of 1 cd, physical sensor": (lamps(1), "sensor.read_noise_e=2.4"),
    "no light": ("lamps=[]", "sun.illuminance_lx=0.001", "sensor.read_noise_e=2.4"),
    **{
        f"{name} floor": (
            *FLOOR_FILE,
            f"terrain.texture_file={{folder}}/{name}.png",
            "terrain.texture_px_m=0.002",
            "terrain.texture_tiling=repeat",
        )
        for name in ("constant", "black", "white", "stripes", "dots", "chequerboard", "faint")
    },
    "strong caustics": (*SUN, "sun.caustics=1.0"),
    "5 frames a second": ("rig.frame_rate_hz=5",),
    "snow 1500": ("snow.density_per_m3=1500",),
    "snow 5000": ("snow.density_per_m3=5000",),
    "focal length error 10 %": ("calibration_error.focal_error=0.1",),
    "focal length error 2 %": ("calibration_error.focal_error=0.02",),
    "baseline error 5 %": ("calibration_error.baseline_error=0.05",),
    "yaw error 0.1 deg": ("calibration_error.right_yaw_deg=0.1",),
    "yaw error 2 deg": ("calibration_error.right_yaw_deg=2",),
    "pitch error 1 deg": ("calibration_error.right_pitch_deg=1",),
    "roll error 1 deg": ("calibration_error.right_roll_deg=1",),
    "left principal point error 5 px": ("calibration_error.left_principal_point_error_px=[5,0]",),
    "right principal point error 2 px": ("calibration_error.right_principal_point_error_px=[2,0]",),
    "right principal point error 2 px down": ("calibration_error.right_principal_point_error_px=[0,2]",),
    "k1 error 0.02": ("calibration_error.k1_error=0.02",),
    "k1 error 0.1": ("calibration_error.k1_error=0.1",),
    "flat port, not calibrated": ("port.kind=flat",),
    "current 0.5 m/s across": ("current.velocity_mps=[0,0.5,0]",),
    "current 0.8 m/s across": ("current.velocity_mps=[0,0.8,0]",),
    "current 0.7 m/s diagonal": ("current.velocity_mps=[0.5,0.5,0]",),
    "current 1.04 m/s": ("current.velocity_mps=[0.8,0.66,0]",),
    "current 0.3 m/s upward": ("current.velocity_mps=[0,0,0.3]",),
    "gusts of 0.2 m/s": ("current.velocity_mps=[0.2,0.1,0]", "current.gust_mps=0.2"),
    "waves of 1 m over 8 m": ("waves.height_m=1.0", "waves.period_s=6", "waves.depth_m=8"),
    "field of view 140 deg": ("rig.hfov_deg=140",),
    "both principal points 8 px": principal_points([8, 0], [8, 0]),
    "both principal points 8 px, turns": (*principal_points([8, 0], [8, 0]), "plan.turns=bow_first"),
    "JPEG quality 12": ("images=jpeg_12",),
    "kelp in a current": ('objects=[{shape="kelp",size_m=0.8,per_m2=1}]', "current.velocity_mps=[0.1,0.25,0]"),
    # optics
    "field of view 110 deg": ("rig.hfov_deg=110",),
    "k2 error 0.1": ("calibration_error.k2_error=0.1",),
    "k1 and k2 errors that cancel": ("calibration_error.k1_error=0.03", "calibration_error.k2_error=-0.12"),
    "out of focus": ("lens.focus_m=0.4", "sensor.f_number=1.4"),
    "lateral colour 1 %": ("lens.lateral_colour=[0.01,-0.01]", "lens.blur_px=[1.5,0.5,1.5]"),
    "domes off centre": ("port.offset_m=[0.004,0.003,0.004]", "port.calibrated_at_m=0"),
    "flat ports, tilted": ("port.kind=flat", "port.tilt_deg=6"),
    "flat ports, calibrated at 0.6 m": ("port.kind=flat", "port.calibrated_at_m=0.6"),
    "rolling shutter in gusts": ("rig.model=gopro_pair", "current.gust_mps=0.15"),
    # calibration
    "both principal points 5 px forward": principal_points([0, 5], [0, 5]),
    "both principal points 3 px across": principal_points([3, 0], [3, 0]),
    "principal points 1.2 px apart": principal_points([0.6, 0], [-0.6, 0]),
    "focal error -3 %, altimeter": ("calibration_error.focal_error=-0.03", "control.height=altimeter"),
    "focal error 3 %, high cross line": ("calibration_error.focal_error=0.03", *CROSS_LINE),
    "baseline error -2 %, DVL": ("calibration_error.baseline_error=-0.02", ALL_SENSORS),
    "baseline and focal errors": (
        "calibration_error.baseline_error=0.02",
        "calibration_error.focal_error=-0.02",
        ALL_SENSORS,
    ),
    "rotated in three axes": (
        "calibration_error.right_roll_deg=0.4",
        "calibration_error.right_pitch_deg=-0.3",
        "calibration_error.right_yaw_deg=0.05",
    ),
    "yaw and k1 errors": ("calibration_error.right_yaw_deg=0.08", "calibration_error.k1_error=-0.01"),
    "k1 error -0.01, vision alone": ("calibration_error.k1_error=-0.01", VISION_ALONE),
    "domes off centre, vision alone": ("port.offset_m=[0.004,0.003,0.004]", "port.calibrated_at_m=0", VISION_ALONE),
    "focal error 2 %, waves": ("calibration_error.focal_error=0.02", "waves.height_m=1.5", "waves.depth_m=8"),
    "ZED rig, pitched": ("rig.model=bluerov2_zed", "calibration_error.right_pitch_deg=0.3"),
    # images
    "right camera a frame late": ("images=late",),
    "dirt on the left port": ("images=dirt",),
    "interlaced": ("images=interlaced",),
    "right image a quarter as bright": ("images=dark",),
    "images of half the resolution": ("images=halved",),
    "right lens out of focus": ("images=soft",),
    "hot pixels": ("images=hot",),
    "eight grey levels": ("images=grey_8",),
    "uncorrected vignetting": ("sensor.shading_correction=false", "sensor.vignetting_power=8"),
    "overexposed": ("imaging.gray_level=0.95",),
    "underexposed": ("imaging.gray_level=0.02",),
    "motion blur": ("sensor.exposure_min_ms=30", "sensor.exposure_max_ms=30", "plan.speed_mps=0.6"),
    # floors
    "cliffs of 1.2 m": ("terrain.kind=cliffs", "terrain.relief_m=1.2"),
    "level mud": ("terrain.kind=flat", "terrain.cover=mud"),
    "shiny floor": ("terrain.specular=0.8", "terrain.specular_width_deg=5"),
    "pipes and crates": (
        'objects=[{shape="pipe",size_m=1.0,per_m2=0.2},{shape="crate",size_m=0.4,per_m2=0.2}]',
        "plan.altitude_m=1.8",
    ),
    "branching corals": ('objects=[{shape="branching_coral",size_m=0.4,per_m2=1.5}]',),
    "corals from 1.2 m": ('objects=[{shape="table_coral",size_m=0.4,per_m2=0.5}]', "plan.altitude_m=1.2"),
    "half shiny floor": ("terrain.specular=0.4", "terrain.specular_width_deg=8"),
    # water and light
    "large flakes of snow": ("snow.density_per_m3=200", "snow.diameter_m=0.01"),
    "one lamp next to the cameras": (
        "lamps=[{position_m=[0.0,0.12,-0.15],intensity_cd=1500}]",
        "water.turbidity=4",
    ),
    "one lamp far to port": ("lamps=[{position_m=[0.0,1.2,0.3],pan_deg=-25,intensity_cd=4000}]",),
    "low sun and caustics": (*SUN, "sun.elevation_deg=20", "sun.caustics=0.6"),
    # vehicle, plan and sensors
    "altitude 5 m": ("plan.altitude_m=5",),
    "overlap 50 %": ("plan.overlap_along=0.5",),
    "0.9 m/s": ("plan.speed_mps=0.9",),
    "waves and gusts, vision alone": (
        "waves.height_m=0.5",
        "waves.depth_m=8",
        "current.gust_mps=0.1",
        VISION_ALONE,
    ),
    "AHRS 2 deg off": fault("ahrs", "wrong", size=2, start_s=0.0),
    "pressure 5 cm off from 10 s on": fault("pressure", "wrong", size=0.05, start_s=10.0),
    "DVL 3 cm/s off": fault("dvl", "wrong", size=0.03, start_s=0.0),
    "silt and fish": (
        'faults=[{part="water",type="silt",start_s=4,size=0.6},{part="fish",type="school",start_s=4,size=12}]',
    ),
    "fish all the time": fault("fish", "school", size=16, start_s=0.0),
    "cameras that freeze now and then": fault("cameras", "intermittent", size=0.1),
}


def ordinary_missions():
    """Returns `N_ORDINARY` missions by name: waters, light, floors, rigs and plans of everyday surveys."""
    missions, rng = {}, np.random.default_rng(2026)
    for k in range(N_ORDINARY):
        water = str(rng.choice(["clear", "I", "IA", "IB", "II", "1C"]))
        altitude_m = rng.uniform(1.5, 2.3)
        overrides = [
            f"water.jerlov={water}",
            f"plan.altitude_m={altitude_m:.2f}",
            f"plan.overlap_along={rng.uniform(0.6, 0.88):.2f}",
            f"plan.overlap_across={rng.uniform(0.4, 0.75):.2f}",
            f"plan.speed_mps={rng.uniform(0.2, 0.4):.2f}",
            f"terrain.kind={rng.choice(['reef', 'fractal', 'ripples'])}",
            f"terrain.relief_m={rng.uniform(0.05, 0.6):.2f}",
            f"current.velocity_mps=[{rng.uniform(-0.2, 0.2):.2f},{rng.uniform(-0.2, 0.2):.2f},0]",
        ]
        variant = int(rng.integers(4))
        overrides += ((), SUN, ("sensor.read_noise_e=2.4",), ("snow.density_per_m3=50",))[variant]
        missions[f"ordinary {k} {water} {('', 'sun', 'sensor', 'snow')[variant]}".strip()] = tuple(overrides)
    return missions


def write_floors(folder):
    """Writes a floor of 7 m x 6 m with 0.5 m of relief, and textures without usable detail."""
    rng, row, col = np.random.default_rng(0), *np.indices((512, 512))
    images = {
        "constant": np.full((512, 512), 128),
        "black": np.zeros((512, 512)),
        "white": np.full((512, 512), 255),
        "stripes": 128 + 80 * np.sign(np.sin(2 * np.pi * col / 32)),
        "dots": 60 + 150 * (np.hypot(row % 64 - 32, col % 64 - 32) < 14),
        "chequerboard": 60 + 130 * ((row // 32 + col // 32) % 2),
        "faint": 128 + cv2.GaussianBlur(rng.standard_normal((512, 512)), (0, 0), 3) * 12,
    }
    height_m = cv2.GaussianBlur(rng.standard_normal((150, 175)), (0, 0), 12)
    np.save(folder / "floor.npy", 0.5 * (height_m - height_m.min()) / np.ptp(height_m))
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), np.clip(image, 0, 255).astype(np.uint8))


def jpeg_12(image, right):
    """Returns an image after compression as JPEG of quality 12."""
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 12])[1], cv2.IMREAD_COLOR)


def dirt(image, right):
    """Returns an image behind 40 blurred stains on the left port, which stay where they are."""
    rng, stains = np.random.default_rng(1), np.zeros(image.shape[:2], np.float32)
    for x, y in rng.uniform(0, 1, (40, 2)) * image.shape[1::-1]:
        cv2.circle(stains, (int(x), int(y)), int(rng.integers(3, 10)), 0.7, -1)
    share = cv2.GaussianBlur(stains, (0, 0), 2)[..., None]
    return image if right else (image * (1 - share) + 90 * share).astype(np.uint8)


def interlaced(image, right):
    """Returns an image with every other row a pixel to the right, as of two fields."""
    return np.where(np.arange(len(image))[:, None, None] % 2, image, np.roll(image, 1, axis=1))


def dark(image, right):
    return image // 4 if right else image


def halved(image, right):
    """Returns the image of a camera of half the resolution, enlarged to the size of the calibration."""
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return cv2.resize(half, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def soft(image, right):
    return cv2.GaussianBlur(image, (0, 0), 2) if right else image


def hot(image, right):
    """Returns an image with 400 white pixels, others in each camera."""
    row, col = (np.random.default_rng(right).uniform(0, 1, (400, 2)) * image.shape[:2]).astype(int).T
    image = image.copy()
    image[row, col] = 255
    return image


def grey_8(image, right):
    return image // 32 * 32 + 16


IMAGES = {f.__name__: f for f in (jpeg_12, dirt, interlaced, dark, halved, soft, hot, grey_8)}


def changed_images(name):
    """Returns a context in which images are those of a function of `IMAGES`, or right ones "late" by a frame."""
    capture = RenderedWorld.capture

    def change(world, step):
        images = capture(world, step)
        if name == "late":
            current = world.right_image() if images.right is None else images.right
            earlier, world.last_right = getattr(world, "last_right", current), current
            return images._replace(right=None if images.right is None else earlier)
        left, right = (image if image is None else IMAGES[name](image, k) for k, image in enumerate(images[:2]))
        return images._replace(left=left, right=right)

    return patch.object(RenderedWorld, "capture", change)


def fly(name, overrides, seed):
    """Returns the row of one survey: how it ended, its largest error and standard deviation, and what it mapped."""
    with tempfile.TemporaryDirectory() as folder:
        write_floors(Path(folder))
        texts = [text.replace("{folder}", folder) for text in (*SHORT, *overrides) if not text.startswith("images=")]
        changes = [changed_images(text[7:]) for text in overrides if text.startswith("images=")]
        row = {"mission": name, "seed": seed}
        try:
            scenario = twin.load_scenario("reef", [*texts, f"seed={seed}"])
            with changes[0] if changes else nullcontext():
                metrics = survey.run(scenario, Path(folder) / "run", outputs=None).metrics
        except TwinError as error:
            return row | {"status": "refused", "reason": str(error)[:200]}
        final, check = metrics["trajectory"].get("final") or {}, metrics.get("self_check") or {}
        row |= {"status": metrics["status"], "reason": metrics.get("reason", "")}
        sigma_m = np.hypot(check.get("sigma_max_m") or 0.0, check.get("frame_sigma_m") or 0.0)  # between keyframes
        row |= {"error_m": final.get("ate_max_m"), "sigma_m": float(sigma_m)}
        row |= {"nees": (metrics.get("consistency") or {}).get("nees_position_mean")}
        found = metrics.get("map") or {}
        return row | {"completeness": found.get("completeness_area"), "map_sigma_ratio": found.get("sigma_ratio")}


def is_wrong(row):
    """Returns whether a survey ended with the wrong status."""
    if row["mission"].startswith("ordinary"):
        return row["status"] != "complete"
    if row["status"] != "complete" or row["mission"] in UNOBSERVABLE:
        return False
    wrong_map = (row.get("map_sigma_ratio") or 0.0) > MAX_MAP_SIGMAS
    return wrong_map or row["error_m"] > MAX_SIGMAS * row["sigma_m"] or row["completeness"] < MIN_COMPLETENESS


def line(row):
    """Returns a survey as a line of the table."""
    figures = ""
    if row.get("error_m") is not None and row.get("sigma_m"):
        figures = f"error {1e3 * row['error_m']:.1f} mm, sigma {1e3 * row['sigma_m']:.1f} mm"
        figures += f", {row['completeness']:.0%} mapped" if row.get("completeness") is not None else ""
        figures += f", map {row['map_sigma_ratio']:.1f} sigma" if row.get("map_sigma_ratio") is not None else ""
    mark = "WRONG" if is_wrong(row) else "ok"
    return f"{mark:5} {row['mission']:36} {row['seed']:3} {row['status']:9} {figures:64} {row['reason'][:150]}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("missions", nargs="*")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--ordinary", action="store_true", help="fly the ordinary missions, one seed each")
    given = parser.parse_args()
    missions = ordinary_missions() if given.ordinary else HOSTILE
    names = [name for word in given.missions for name in (FAULTS if word == "faults" else [word])]
    chosen = {name: missions[name] for name in names or missions}
    rows = [json.loads(text) for text in given.out.read_text().splitlines()] if given.out.exists() else []
    flown = {(row["mission"], row["seed"]) for row in rows}
    seeds = range(101, 102) if given.ordinary else range(given.first, given.seeds + 1)
    waiting = [(name, chosen[name], seed) for seed in seeds for name in chosen if (name, seed) not in flown]
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool, given.out.open("a") as file:
        for done in as_completed([pool.submit(fly, *survey) for survey in waiting]):
            rows.append(done.result())
            print(json.dumps(rows[-1]), file=file, flush=True)
            print(line(rows[-1]), flush=True)
    wrong = [row for row in rows if row["mission"] in missions and is_wrong(row)]
    print(f"\n{len(wrong)} of {len(rows)} surveys ended with the wrong status", *map(line, wrong), sep="\n")
    return len(wrong) > (1 if given.ordinary else 0)


if __name__ == "__main__":
    sys.exit(main())
