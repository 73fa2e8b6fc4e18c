"""Ports: rays by Snell's law against independent ray tracing; the equivalent pinhole and its error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq, root

from twin.errors import ScenarioError
from twin.imaging.camera import true_cameras
from twin.imaging.camera.port import air_coordinates, pinhole, refract, water_rays
from twin.imaging.camera.ray_sampling import sample_rays
from twin.imaging.camera.true_cameras import make_true_cameras
from twin.scenario.file import load_scenario
from twin.scenario.model import PortConfig, Scenario
from twin.world.mission import prepare

FLAT = {"kind": "flat", "thickness_m": 0.012, "distance_m": 0.03}
TILTED = FLAT | {"tilt_deg": 8.0}
DOME = {"kind": "dome", "thickness_m": 0.006, "radius_m": 0.06, "offset_m": (0.0, 0.0, 0.008)}
SIZE = {"image_width_px": 320, "image_height_px": 240}
#: Tangents and depths of the test points.
TANGENTS, DEPTHS_M = [0.0, 0.05, 0.2, 0.35, 0.5], [0.5, 1.0, 2.0, 4.0]


def scenario(**sections) -> Scenario:
    return Scenario.model_validate({"rig": SIZE} | sections)


def tangent_of_pane(port: PortConfig, across_m: float, ahead_m: float) -> float:
    """Returns the tangent in air of the ray from the pupil to a point, by root finding on Snell's law in 2D."""

    def across_at(angle):
        glass, water = (np.arcsin(np.sin(angle) / n) for n in (port.glass_index, port.water_index))
        behind_m = ahead_m - port.distance_m - port.thickness_m
        return port.distance_m * np.tan(angle) + port.thickness_m * np.tan(glass) + behind_m * np.tan(water)

    return float(np.tan(brentq(lambda angle: across_at(angle) - across_m, 0.0, np.deg2rad(89.9), xtol=1e-14)))


def coordinates_by_fermat(port: PortConfig, point_m: np.ndarray) -> np.ndarray:
    """Returns the normalised coordinates (2,) in air for any port by Fermat's principle (stationary optical length)."""
    tilt = np.deg2rad(port.tilt_deg)
    along_pane = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), np.sin(tilt)]])
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])

    def on_face(coordinates, depth_m):
        if port.kind == "flat":
            return coordinates @ along_pane + (port.distance_m + depth_m) * normal
        toward = np.array([*coordinates, 1.0])
        return np.array(port.offset_m) + (port.radius_m + depth_m) * toward / np.linalg.norm(toward)

    def optical_path_m(coordinates):
        corners = [np.zeros(3), on_face(coordinates[:2], 0.0), on_face(coordinates[2:], port.thickness_m), point_m]
        lengths_m = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        return float(lengths_m @ (1.0, port.glass_index, port.water_index))

    # steps of 1e-5: rounding of 1e-16 m is an error of 1e-11 in the slope, 1e-12 m in position
    def slopes(coordinates):
        return [(optical_path_m(coordinates + h) - optical_path_m(coordinates - h)) / 2e-5 for h in 1e-5 * np.eye(4)]

    scale = port.distance_m if port.kind == "flat" else 1.0
    found = root(slopes, np.tile(point_m[:2] / point_m[2] * scale, 2), tol=1e-12).x
    for _ in range(8):  # Newton's method where `root` stops early
        steps = 1e-5 * np.eye(4)
        hessian = [(np.array(slopes(found + h)) - slopes(found - h)) / 2e-5 for h in steps]
        found = found - np.linalg.solve(hessian, slopes(found))
    assert np.abs(slopes(found)).max() < 1e-8
    x, y, z = on_face(found[:2], 0.0)
    return np.array([x, y]) / z


@pytest.mark.parametrize("depth_m", DEPTHS_M)
@pytest.mark.parametrize("tangent", TANGENTS)
def test_a_flat_port_agrees_with_snells_law(tangent, depth_m):
    """Within 1e-4 px in a frame 320 px wide; the requirement for images is 0.01 px."""
    port, azimuth = PortConfig(**FLAT), np.deg2rad(35)
    across_m = tangent * depth_m
    point = np.array([[across_m * np.cos(azimuth), across_m * np.sin(azimuth), depth_m]])
    expected = tangent_of_pane(port, across_m, depth_m) * np.array([np.cos(azimuth), np.sin(azimuth)])
    np.testing.assert_allclose(air_coordinates(port, point)[0], expected, atol=1e-4 / 277)


@pytest.mark.parametrize("depth_m", [0.5, 4.0])
@pytest.mark.parametrize("port", [FLAT, TILTED, DOME, DOME | {"offset_m": (0.01, -0.004, 0.008)}])
def test_a_port_agrees_with_fermats_principle(port, depth_m):
    here = PortConfig(**port)
    points = np.array([[0.05, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.2, 0.45, 1.0], [-0.5, -0.35, 1.0]]) * depth_m
    expected = [coordinates_by_fermat(here, point) for point in points]
    np.testing.assert_allclose(air_coordinates(here, points), expected, atol=1e-4 / 277)


def test_refraction_follows_snells_law_in_the_plane_of_incidence():
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ray = normal + 0.5 * rng.normal(size=(50, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray *= np.sign((ray * normal).sum(axis=1, keepdims=True))
    refracted = refract(ray, normal, 1 / 1.339)
    np.testing.assert_allclose(np.linalg.norm(refracted, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(1.339 * np.cross(refracted, normal), np.cross(ray, normal), atol=1e-12)
    assert ((refracted * normal).sum(axis=1) > 0).all()


def test_total_reflection_beyond_the_critical_angle_is_nan():
    steep = np.array([[np.sin(1.0), 0.0, np.cos(1.0)]])  # 57 deg; from 1.339 to air the limit is 48.3 deg
    assert np.isnan(refract(steep, np.array([[0.0, 0.0, 1.0]]), 1.339)).all()


@pytest.mark.parametrize("sections", [FLAT | {"tilt_deg": 12.0}, DOME | {"offset_m": (0.01, -0.004, 0.008)}])
def test_a_port_of_index_one_has_no_effect(sections):
    port = PortConfig(**sections, glass_index=1.0, water_index=1.0)
    normalised = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 2))
    origin, direction = water_rays(port, normalised)
    np.testing.assert_allclose(direction[:, :2] / direction[:, 2:], normalised, atol=1e-14)
    np.testing.assert_allclose(origin[:, :2] / origin[:, 2:], normalised, atol=1e-14)
    assert pinhole(port).focal_ratio == pytest.approx(1, abs=1e-9)
    assert pinhole(port).centre_m == pytest.approx(0, abs=1e-9)


def test_a_dome_centred_on_the_pupil_does_not_refract():
    port = PortConfig(**DOME | {"offset_m": (0.0, 0.0, 0.0)})
    normalised = np.random.default_rng(0).uniform(-0.9, 0.9, (20, 2))
    origin, direction = water_rays(port, normalised)
    np.testing.assert_allclose(direction[:, :2] / direction[:, 2:], normalised, atol=1e-13)
    np.testing.assert_allclose(np.cross(origin, direction), 0, atol=1e-15)  # through the pupil
    assert pinhole(port) == pytest.approx((0, 1), abs=1e-9)


def test_the_direction_in_water_does_not_depend_on_the_glass():
    """A pane displaces a ray; a very thin pane does not even do that."""
    normalised = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 2))
    _, acrylic = water_rays(PortConfig(**FLAT), normalised)
    _, flint = water_rays(PortConfig(**FLAT, glass_index=1.9), normalised)
    np.testing.assert_allclose(acrylic, flint, atol=1e-14)
    thin = [water_rays(PortConfig(**FLAT | {"thickness_m": 1e-9, "glass_index": g}), normalised)[0] for g in (1.3, 1.9)]
    np.testing.assert_allclose(thin[0], thin[1], atol=1e-8)
    np.testing.assert_allclose(thin[0], 0.03 * np.column_stack([normalised, np.ones(20)]), atol=1e-8)


def test_the_equivalent_pinhole_of_a_pane_follows_gaussian_optics():
    """Focal length n times that of the lens, centre d (n - 1) + t (n / g - 1) behind the pupil."""
    equivalent = pinhole(PortConfig(**FLAT))
    assert equivalent.focal_ratio == pytest.approx(1.339, rel=1e-7)
    assert equivalent.centre_m == pytest.approx(-(0.03 * 0.339 + 0.012 * (1.339 / 1.49 - 1)), rel=1e-6)


@pytest.mark.parametrize("port", [FLAT, DOME])
def test_the_image_centre_has_the_believed_scale_at_every_depth(port):
    here = scenario(port=port)
    for depth_m in DEPTHS_M:
        point = np.array([[0.01, -0.004, 1.0]]) * depth_m
        off_px = make_true_cameras(here).project(point) - here.believed_rig().project(point)
        assert np.abs(off_px).max() < 1e-3  # 3 px from the centre; the error grows with the third power


@pytest.mark.parametrize("port", [FLAT, FLAT | {"tilt_deg": 5.0}, DOME | {"offset_m": (0.004, 0.003, 0.008)}])
def test_a_calibrated_port_is_exact_at_the_calibration_depth_only(port):
    here = scenario(port=port | {"calibrated_at_m": 2.0})
    cameras, rig = make_true_cameras(here), here.believed_rig()
    at_2, at_1 = (np.array([[0.5, 0.3, 1.0], [-0.4, -0.35, 1.0]]) * depth_m for depth_m in (2.0, 1.0))
    np.testing.assert_allclose(cameras.project(at_2), rig.project(at_2), atol=1e-6)
    assert 0.05 < np.abs(cameras.project(at_1) - rig.project(at_1)).max() < 5


def test_the_error_of_the_equivalent_pinhole_has_the_closed_form():
    """A point at infinity and tangent 0.5 is imaged at f / n tan(asin(n sin(atan 0.5)))."""
    here = scenario(port=FLAT)
    angle = np.arctan(0.5)
    expected = here.believed_rig().focal_px / 1.339 * np.tan(np.arcsin(1.339 * np.sin(angle)))
    far = np.array([[0.5, 0.0, 1.0]]) * 1e5
    assert make_true_cameras(here).project(far)[0, 0] - 159.5 == pytest.approx(expected, abs=1e-3)


# --- images ------------------------------------------------------------------------------------------------------


def floor_with_dots(rig, slope: float, dots: np.ndarray, sigma_px: float = 2.0):
    """Returns radiance of white dots at normalised coordinates (n, 2), the depth of the plane z = 1.5 + slope x, and
    the dots in 3D."""
    u, v = np.meshgrid(np.arange(rig.width_px), np.arange(rig.height_px))
    depth = 1.5 / (1 - slope * (u - rig.cx_px) / rig.focal_px)
    light = np.zeros((*u.shape, 3), np.float32)
    for x, y in dots:
        off = (u - rig.cx_px - x * rig.focal_px) ** 2 + (v - rig.cy_px - y * rig.focal_px) ** 2
        light += np.exp(-off / (2 * sigma_px**2)).astype(np.float32)[..., None]
    points = np.column_stack([dots, np.ones(len(dots))]) * (1.5 / (1 - slope * dots[:, :1]))
    return light, depth.astype(np.float32), points


def brightest(light: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Returns the maximum of a dot [px]: of the paraboloid through the logarithm of the nine pixels around it.

    The centroid is not used: distortion makes a dot asymmetric, which moves its centroid (0.06 px here), but not its
    maximum.
    """
    c, r = np.rint(around).astype(int)
    v, u = np.mgrid[-1:2, -1:2].reshape(2, -1)
    top = np.log(light[r + v, c + u, 0].astype(float))
    _, *slope, uu, vv, uv = np.linalg.lstsq(np.stack([v**0, u, v, u * u, v * v, u * v], 1), top, rcond=None)[0]
    return np.array([c, r]) - np.linalg.solve([[2 * uu, uv], [uv, 2 * vv]], slope)


@pytest.mark.parametrize(("port", "slope"), [(FLAT, 0.0), (FLAT, 0.6), (FLAT, -0.9), (TILTED, 0.6), (DOME, 0.6)])
def test_images_of_points_agree_with_ray_tracing(port, slope):
    """Dots on flat and steep floors, seen through a port: within 0.01 px of Fermat's principle."""
    here = scenario(port=port)
    cameras, equivalent = make_true_cameras(here), pinhole(here.port)
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 5), np.linspace(-0.3, 0.3, 4))
    light, depth, points = floor_with_dots(cameras.rendered_rig, slope, np.column_stack([x.ravel(), y.ravel()]) + 0.003)
    raw = cameras.sample(light, depth, 0)
    off = []
    for point in points:
        normalised = coordinates_by_fermat(here.port, point + [0.0, 0.0, equivalent.centre_m])
        expected = here.believed_rig().focal_px / equivalent.focal_ratio * normalised + [159.5, 119.5]
        off.append(brightest(raw, expected) - expected)
    assert np.abs(off).max() < 0.01


@pytest.mark.parametrize("slope", [0.6, -0.9])
def test_the_ray_intersection_converges_on_a_sloping_floor(slope):
    cameras = make_true_cameras(scenario(port=FLAT))
    sampling, (_, depth, _) = cameras.sampling[0], floor_with_dots(cameras.rendered_rig, slope, np.zeros((1, 2)))
    columns = np.zeros((*depth.shape, 3), np.float32) + np.arange(depth.shape[1], dtype=np.float32)[:, None]
    u = sample_rays(columns, depth, *sampling)[..., 0]  # the spline of an image of columns is exact
    # along a ray x / z = q + p / z on the plane 1 / z = (1 - slope x / z) / 1.5, solved for x / z
    f, cx = cameras.rendered_rig.focal_px, cameras.rendered_rig.cx_px
    q, p = sampling.positions[..., 0] - cx, sampling.parallax_px_m[..., 0]
    exact = (q + p / 1.5) / (1 + p / f * slope / 1.5) + cx
    assert np.abs(u - exact).max() < 2e-4  # single precision at 300 px is 3e-5, for the position and for the sum


def test_points_at_infinity_have_no_parallax():
    cameras = make_true_cameras(scenario(port=FLAT))
    sampling = cameras.sampling[0]
    light = np.random.default_rng(0).random(
        (cameras.rendered_rig.height_px, cameras.rendered_rig.width_px, 3), np.float32
    )
    empty = np.full(light.shape[:2], np.inf, np.float32)
    np.testing.assert_array_equal(
        sample_rays(light, empty, *sampling), sample_rays(light, empty, sampling.positions, None)
    )


BAD_PORTS = [
    ("thickness_m = 0", "port.thickness_m: 0: not allowed (allowed: greater than 0)"),
    ("thickness_m = -0.01", "port.thickness_m: -0.01: not allowed (allowed: greater than 0)"),
    ("distance_m = 0.0", "port.distance_m: 0.0: not allowed (allowed: greater than 0)"),
    ("radius_m = -1.0", "port.radius_m: -1.0: not allowed (allowed: greater than 0)"),
    ("glass_index = 0.9", "port.glass_index: 0.9: not allowed (allowed: greater than or equal to 1)"),
    ("water_index = 3.0", "port.water_index: 3.0: not allowed (allowed: less than or equal to 2)"),
    ("calibrated_at_m = -1", "port.calibrated_at_m: -1: not allowed (allowed: greater than or equal to 0)"),
    ('kind = "round"', "port.kind: 'round': not allowed (allowed: 'none', 'flat' or 'dome')"),
    (
        'kind = "dome"\noffset_m = [0.0, 0.0, 0.05]',
        "port.offset_m: 0.05 m: the lens is outside its dome (allowed: shorter than port.radius_m, 0.05 m)",
    ),
]


@pytest.mark.parametrize(("lines", "message"), BAD_PORTS)
def test_an_invalid_port_is_rejected_with_file_and_line(tmp_path, lines, message):
    file = tmp_path / "bad.toml"
    file.write_text(f'extends = "{load_scenario("reef").source.path}"\n[port]\n{lines}\n')
    with pytest.raises(ScenarioError) as error:
        prepare(load_scenario(file))
    assert error.value.lines == [f"{file}:{2 + len(lines.splitlines())}: {message}"]


def test_a_field_of_view_beyond_the_port_is_rejected():
    wide = ["rig.hfov_deg=110.0", "port.kind=flat", "port.calibrated_at_m=2.0"]
    with pytest.raises(ScenarioError, match=r"rig\.hfov_deg: no rays reach the corners of the frame"):
        prepare(load_scenario("reef", wide))


def test_the_true_cameras_of_a_seed_do_not_depend_on_those_made_before():
    """Rays of lens and port are kept from call to call; the rotation of the right camera is that of the seed."""
    drawn = [scenario(port=DOME, calibration_error={"rotation_sigma_deg": 0.1}, seed=seed) for seed in (1, 2)]
    fresh = []
    for one in drawn:
        true_cameras._sensor_rays.cache_clear()
        true_cameras._rectification.cache_clear()
        fresh.append(make_true_cameras(one).sampling)
    again = [make_true_cameras(one).sampling for one in (drawn[0], drawn[1])]
    for (left, right), (kept_left, kept_right) in zip(fresh, again, strict=True):
        np.testing.assert_array_equal(left.positions, kept_left.positions)
        np.testing.assert_array_equal(right.positions, kept_right.positions)
    assert np.abs(fresh[0][1].positions - fresh[1][1].positions).max() > 0.1
