"""Surrogate: relief of the floor and errors of sampled maps, against their law and closed forms."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.height_field import height_field
from twin.core.records import MapGrid, StereoRig
from twin.surrogate import error_model_file
from twin.surrogate.floor_relief import edge_strength, floor_relief, roughness, step_slope
from twin.surrogate.height_errors import CellConditions, height_sigmas, relief_error_px
from twin.surrogate.map_model import MapModel, heavy_tailed, window_noise
from twin.surrogate.matchability import EVEN_TEXTURE, NO_DEPENDENCE, PositionDependence, WindowTexture
from twin.surrogate_fit.comparison_vision import exact_map_model

MODEL = error_model_file.load().model
EXACT = exact_map_model(MODEL)
RIG = StereoRig(320, 240, 277.0, 0.12, 15.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
#: A bump and a slope, at nodes 2 cm apart.
X, Y = np.meshgrid(np.arange(-80, 81) * 0.02, np.arange(-80, 81) * 0.02)
BUMPY = 0.1 * np.exp(-4 * (X**2 + Y**2)) + 0.05 * X


def tilted(x, y, z):
    return geometry.pose(geometry.rotation_from_rpy(np.pi - 0.15, 0.1, 0.7), np.array([x, y, z]))


def level(x, z=2.0):
    return geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([x, 0.0, z]))


def map_model_over(height_m, bound_px=0.0, dependence=NO_DEPENDENCE, texture=EVEN_TEXTURE):
    """Returns the map model of a floor with heights (n, n) at nodes 2 cm apart around the origin."""
    n = len(height_m)
    west = -(n - 1) * 0.02 / 2
    grid = MapGrid(west - 0.01, -west + 0.01, 0.02, n, n)
    matchability = SimpleNamespace(
        medium_depth_m=2.0, dependence=dependence, texture=texture, lamp_share=0.0, binning=1,
        bound_at=lambda depth_m: np.full(np.shape(depth_m), bound_px),
    )  # fmt: skip
    floor = height_field(height_m, 0.02, west, west)
    model = MapModel(grid, height_m[::-1].astype(np.float32), RIG, floor, matchability)
    model.keep_conditions()
    return model


def patch_of(model, errors, pose, next_pose=None, estimated=None, seed=0):
    """Returns the height patch of a keyframe; `estimated` is its estimated pose, by default the true one."""
    rng = np.random.default_rng(seed)
    noise = model.new_noise(errors, rng)
    return patches_of(model, errors, noise, [pose, next_pose], estimated, rng)


def patches_of(model, errors, noise, poses, estimated=None, rng=None):
    """Returns the last patch of consecutive keyframes; the last pose only limits the patch before it, None: nothing."""
    rng, patch = rng or np.random.default_rng(1), None
    for pose, next_pose in pairwise(poses):
        observed = model.observe(pose, pose if estimated is None else estimated)
        following = None if next_pose is None else model.observe(next_pose, next_pose)
        patch = model.sample_patch(observed, following, np.zeros((6, 6)), errors, noise, rng)
    return patch


def on_patch(values, patch, model):
    """Returns the values (rows * cols,) of a map's cells in the window of a patch, with the shape of the patch."""
    rows, cols = patch.height_m.shape
    return values.reshape(model.height_m.shape)[patch.row : patch.row + rows, patch.col : patch.col + cols]


def cells(n=1, **given):
    """Returns conditions of n cells: a level floor of 1 m per pixel, observed once far from the border."""
    usual = dict.fromkeys(CellConditions._fields, 0.0) | {"metres_per_px": 1.0, "views": 1.0, "border_px": 1e3}
    usual |= {"border_heights": 10.0}
    return CellConditions(**{name: np.broadcast_to(x, n).astype(float) for name, x in (usual | given).items()})


def test_the_error_due_to_relief_is_quadratic_for_small_roughness_and_limited_for_large():
    """The limit times q^2 for q << 1 and the limit for q >> 1; at q = 1 limit / sqrt(2)."""
    for q, expected in ((0.1, 3e-4), (1.0, 0.03 / np.sqrt(2)), (10.0, 0.03)):
        assert relief_error_px(q * 0.03, 0.03) == pytest.approx(expected, rel=1e-3)


def test_noise_of_depth_decreases_with_the_number_of_keyframes_and_their_distance():
    """Variance / (1 + g (n - 1)), g = gain B^2 / (B^2 + half^2) + s, with the share s of image noise."""
    model = MODEL._replace(flow_floor_px=0.06, efficiency=0.08 / np.sqrt(2), depth_gain=2.0, depth_half_step=1.5)
    for step in (0.0, 1.0, 2.0):
        one, four = (
            height_sigmas(model, cells(window_px=1.0, views=n, step_baselines=step)).noise_m for n in (1.0, 4.0)
        )
        gain = 2.0 * step**2 / (step**2 + 1.5**2) + 0.64
        assert one == pytest.approx(0.1)
        assert (four / one) ** 2 == pytest.approx(1 / (1 + 3 * gain))


def test_at_an_infinite_bound_noise_causes_all_errors_and_no_cell_has_a_height():
    assert MODEL.noise_share(np.inf) == pytest.approx(1.0)
    sigmas = height_sigmas(MODEL, cells(bound_px=np.inf, window_px=np.inf, texture_scatter=0.3))
    assert sigmas.known < 1e-9 and sigmas.scatter == pytest.approx(0.3 * MODEL.texture_scatter)


def test_errors_grow_towards_the_border_of_the_image():
    """Twice the noise at the border, by half of a window of 5 px; 1 + 1.2 exp(-6 b / height) near walls."""
    border_px = np.array([0.0, 2.5, 40.0, 120.0])
    sigmas = height_sigmas(MODEL, cells(4, border_px=border_px, border_heights=border_px / 240, edge_m=1.0))
    np.testing.assert_allclose(sigmas.noise_m / sigmas.noise_m[-1], 1 + np.exp(-border_px / 2.5), rtol=1e-6)
    np.testing.assert_allclose(sigmas.edge_m / MODEL.edge_error, 1 + 1.2 * np.exp(-6 * border_px / 240))


def test_rough_cells_border_cells_and_turbid_water_have_holes():
    for given in ({"roughness_px": MODEL.edge_half_px}, {"bound_px": MODEL.map_half_px, "border_px": 1e6}):
        assert height_sigmas(MODEL, cells(**given)).known == pytest.approx(0.5, abs=1e-6)
    distance = MODEL.border_holes * 0.05
    near = height_sigmas(MODEL, cells(bound_px=0.05, border_px=distance / 2, views=4.0)).known
    far = height_sigmas(MODEL, cells(bound_px=0.05)).known
    assert near / far == pytest.approx(1 - np.exp(-1), rel=1e-6)


def test_the_noise_near_walls_has_unit_variance_most_of_which_is_in_few_cells_that_form_patches():
    """|n| > 1.5 in 13.4 % of the cells; the integral of n^4 over them is 80 % of 3, its mean."""
    noise = heavy_tailed(window_noise((1500, 1500), 4, np.random.default_rng(0)))
    assert (noise.mean(), noise.std()) == (pytest.approx(0.0, abs=0.02), pytest.approx(1.0, abs=0.04))
    large = np.abs(noise) > 1.5**2 / np.sqrt(3)
    assert large.mean() == pytest.approx(0.134, abs=0.005)
    assert np.sum(noise[large] ** 2) / np.sum(noise**2) == pytest.approx(0.81, abs=0.02)
    assert np.mean(large[:, 1:][large[:, :-1]]) > 0.4  # gross errors come in patches; 0.134 if independent


def test_only_windows_with_a_wall_have_edges_and_their_strength_grows_with_the_slope():
    """An undulating floor has roughness but no walls; the columns 19 and 20 of a step are steep."""
    height = np.tile(0.002 * np.cos(np.arange(40)), (30, 1)).astype(np.float32)
    height[:, 20:] += 0.4
    rough, slope = roughness(height, 5), step_slope(height, 0.02)
    edge = edge_strength(rough, slope, 5)
    assert rough[15, 3:15].min() > 4e-4
    assert np.flatnonzero(edge[15]).tolist() == list(range(17, 23))  # windows of five with one of the columns 19 and 20
    largest = np.array([rough[15, j - 2 : j + 3].max() for j in range(17, 23)])
    least = np.maximum(slope[15, 17:23], 0.1)
    np.testing.assert_allclose(edge[15, 17:23] ** 4, rough[15, 17:23] * largest * least**2, rtol=1e-4)


def test_the_slope_of_a_step_between_two_cells_is_not_halved_and_that_of_a_plane_is_exact():
    y, x = np.mgrid[:20, :30] * 0.02
    plane = step_slope((0.3 * x - 0.4 * y).astype(np.float32), 0.02)
    np.testing.assert_allclose(plane, 0.5, rtol=1e-3)
    step = step_slope(np.where(x > 0.29, 0.1, 0.0).astype(np.float32), 0.02)
    np.testing.assert_allclose(step[:, 14:16], 5.0, rtol=1e-5)
    assert step[:, :14].max() == step[:, 16:].max() == 0


def test_the_roughness_is_that_of_a_curved_floor_and_zero_on_a_plane():
    """For z = a x^2 it is the standard deviation of a x^2 over the window; for a plane it is zero."""
    curved, plane = (floor_relief(h.astype(np.float32), 0.02, RIG, 2.0) for h in (0.5 * X**2, 0.3 * X + 0.2 * Y))
    n = 2 * max(round((curved.window_cells - 1) / 2), 1) + 1
    across_m = (np.arange(n) - n // 2) * 0.02
    inner = np.s_[10:-10, 10:-10]
    np.testing.assert_allclose(curved.roughness_m[inner], np.std(0.5 * across_m**2), rtol=1e-3)
    assert plane.roughness_m[inner].max() < 1e-6


def test_without_errors_the_patch_of_a_keyframe_is_the_true_floor():
    model = map_model_over(BUMPY)
    patch = patch_of(model, EXACT, tilted(0.1, 0.2, 2.0))
    known = np.isfinite(patch.height_m)
    assert known.sum() > 5000
    np.testing.assert_allclose(patch.height_m[known], on_patch(model.height_m, patch, model)[known], atol=1e-3)


def test_a_height_error_of_the_pose_shifts_the_patch_without_the_cells_of_the_next_keyframe():
    model, pose, next_pose = map_model_over(BUMPY), tilted(0.1, 0.2, 2.0), tilted(0.3, 0.2, 2.0)
    raised = pose.copy()
    raised[2, 3] += 0.01
    whole, strip = (patch_of(model, EXACT, pose, n, raised) for n in (None, next_pose))
    assert np.nanmean(whole.height_m - on_patch(model.height_m, whole, model)) == pytest.approx(0.01, abs=1e-5)
    assert 0.05 < np.isfinite(strip.height_m).sum() / np.isfinite(whole.height_m).sum() < 0.4


def test_the_variance_due_to_the_pose_is_that_of_its_height_and_of_its_tilt():
    """At 2 m above a level floor, a roll of s rad displaces the floor by s y, a vertical error by itself."""
    model, cov = map_model_over(0 * X), np.diag([0.01, 0, 0, 0, 0, 0.003]) ** 2
    observed, noise = model.observe(level(0.0), level(0.0)), model.new_noise(EXACT, np.random.default_rng(0))
    patch = model.sample_patch(observed, None, cov, EXACT, noise, np.random.default_rng(0))
    y = model.grid.centres()[1][patch.row : patch.row + len(patch.height_m)]
    x = model.grid.centres()[0][patch.col : patch.col + patch.height_m.shape[1]]
    axis = level(0.0)[:3, 0]  # of the first rotation, in world axes
    expected = 0.003**2 + 0.01**2 * (axis[0] * y[:, None] - axis[1] * x) ** 2
    known = np.isfinite(patch.height_m)
    np.testing.assert_allclose(patch.systematic_m2[known], np.broadcast_to(expected, known.shape)[known], rtol=1e-3)


def test_a_wall_hides_the_floor_behind_it_from_the_map():
    """Cameras 1.5 m above the upper terrace, 0.8 m from its edge: a strip of 0.8 m / 1.5 at the foot is hidden."""
    x = np.arange(-100, 101) * 0.02
    model = map_model_over(np.broadcast_to(np.where(x > 0, 1.0, 0.0), (201, 201)))
    model.mark_seen(level(0.8, 2.5))
    row = model.seen[100]
    assert row[(x > 0.2) & (x < 1.4)].all()
    assert not row[(x > -0.8 / 1.5 + 0.02) & (x < -0.02)].any()
    model.mark_seen(level(-0.8, 2.5))
    assert model.seen[100][(x > -1.5) & (x < -0.02)].all()


def test_the_runs_of_keyframes_that_observe_a_cell_are_counted():
    model, poses = map_model_over(BUMPY), [tilted(0.1 + 0.12 * k, 0.2, 2.0) for k in range(4)]
    noise = model.new_noise(EXACT, np.random.default_rng(0))
    patch = patches_of(model, EXACT, noise, [*poses, None])
    views = on_patch(model.conditions.views, patch, model)[np.isfinite(patch.height_m)]
    assert set(views) == {1.0, 2.0, 3.0, 4.0} and np.mean(views == 4) > 0.5
    steps = on_patch(model.conditions.step_baselines, patch, model)[np.isfinite(patch.height_m)]
    np.testing.assert_allclose(steps, np.where(views > 1, 0.12 / RIG.baseline_m, 0.0), atol=1e-9)
    assert set(model.n_heights) == {0, 1}


def test_the_errors_of_a_map_are_normal_with_the_standard_deviation_of_their_cell():
    """A scale mixture: the kurtosis of the errors is 3 exp(4 s^2) for a scatter s, that of error / sigma is 3.

    The precision of a cell is the same for all keyframes that show it. The cells of a window are not independent.
    """
    model = map_model_over(0 * X, bound_px=1.0, texture=WindowTexture(1.0, 0.4))
    errors = EXACT._replace(efficiency=0.1, texture_scatter=1.0)
    rng = np.random.default_rng(0)
    noise = model.new_noise(errors, rng)
    noise = noise._replace(scatter=rng.standard_normal(model.height_m.shape, np.float32))
    patches = [patches_of(model, errors, noise, [level(0.0), None], rng=rng) for _ in range(8)]
    inner = np.s_[5:-5, 5:-5]
    error = np.array([patch.height_m[inner] for patch in patches], np.float64)
    sigma = np.sqrt(patches[0].variance_m2[inner])
    np.testing.assert_allclose(patches[7].variance_m2[inner], sigma**2, rtol=1e-5)
    assert np.log(sigma).std() == pytest.approx(0.4, rel=0.05)

    def kurtosis(x):
        return float(np.mean(x**4) / np.mean(x**2) ** 2)

    assert kurtosis(error / sigma) == pytest.approx(3, rel=0.1)
    assert kurtosis(error) == pytest.approx(3 * np.exp(4 * 0.4**2), rel=0.25)


def test_the_errors_of_neighbouring_cells_have_the_correlation_of_overlapping_squares():
    model = map_model_over(0 * X, bound_px=1.0)
    error = patch_of(model, EXACT._replace(efficiency=0.1), level(0.0)).height_m
    known = np.isfinite(error)
    both = known[:, 1:] & known[:, :-1]
    correlation = np.corrcoef(error[:, 1:][both], error[:, :-1][both])[0, 1]
    assert model.correlated_cells > model.relief.window_cells > 1
    assert correlation == pytest.approx(1 - 1 / model.correlated_cells, abs=0.05)


def test_the_noise_of_edges_has_unit_variance_and_the_correlation_of_a_window():
    """Means over windows of four cells share three quarters of their cells with those of the neighbours."""
    noise = window_noise((400, 400), 4, np.random.default_rng(0))
    assert noise.std() == pytest.approx(1.0, rel=0.03)
    assert np.mean(noise[:, 1:] * noise[:, :-1]) == pytest.approx(0.75, abs=0.05)


def test_only_cells_near_a_wall_have_the_errors_of_edges():
    model = map_model_over(np.where(X > 0, 0.1, 0.0))
    errors = EXACT._replace(edge_error=2.0)
    noise = model.new_noise(errors, np.random.default_rng(0))
    noise = noise._replace(edge=np.ones_like(noise.edge))
    patch = patches_of(model, errors, noise, [level(0.0), None])
    plain = patches_of(model, EXACT, noise, [level(0.0), None])
    known = np.isfinite(patch.height_m)
    difference = (patch.height_m - plain.height_m)[known]
    factor = 1 + 1.2 * np.exp(-6 * on_patch(model.conditions.border_px, patch, model)[known] / 240)
    expected = 2 * factor * on_patch(model.relief.edge_m, patch, model)[known]
    np.testing.assert_allclose(difference, expected, atol=2e-3)
    assert difference.max() > 0.04 and np.median(difference) < 1e-3


def test_errors_of_depth_follow_the_bound_at_the_position_in_the_image():
    """The bound is 1 at the left and 2 at the right border, so its square is a ramp of information between them."""
    ramp = PositionDependence(np.array([[1.0, 2.0]]), np.ones((1, 1)))
    even, model = map_model_over(0 * X, 1.0), map_model_over(0 * X, 1.0, ramp)
    errors = EXACT._replace(efficiency=0.1)
    plain, patch = (patch_of(m, errors, level(0.0)) for m in (even, model))
    x, y = (on_patch(part.ravel(), patch, model) for part in np.meshgrid(*model.grid.centres()))
    across = level(0.0)[0, 0] * x + level(0.0)[1, 0] * y  # in camera axes
    column = (RIG.focal_px * across / 2.0 + RIG.cx_px + 0.5) / RIG.width_px * 2 - 0.5
    ratio2 = 1 / (1 - 0.75 * np.clip(column, 0, 1))
    known = np.isfinite(patch.height_m)
    np.testing.assert_allclose((patch.variance_m2 / plain.variance_m2)[known], ratio2[known], rtol=5e-3)
    np.testing.assert_allclose((patch.height_m / plain.height_m)[known], np.sqrt(ratio2)[known], rtol=5e-3)


def test_a_height_that_is_not_a_number_is_an_error_and_not_a_hole():
    with pytest.raises(FloatingPointError, match="height"):
        patch_of(map_model_over(BUMPY), EXACT._replace(lateral_sigma_px=np.nan), tilted(0.1, 0.2, 2.0))


def test_the_cells_that_a_keyframe_sees_project_into_both_images():
    """Against the projection of the calibration, over a floor without cells that relief may hide."""
    model, pose = map_model_over(BUMPY), tilted(0.1, 0.2, 2.0)
    model.mark_seen(pose)
    x, y = np.meshgrid(*model.grid.centres())
    centres = np.column_stack([x.ravel(), y.ravel(), model.height_m.ravel()])
    inside = np.ones(len(centres), np.bool_)
    for camera in (pose, pose @ RIG.left_from_right):
        pixels = RIG.project(geometry.transform(geometry.inverse(camera), centres))
        inside &= np.all((pixels >= 0) & (pixels <= [RIG.width_px - 1, RIG.height_px - 1]), axis=1)
    assert 5000 < inside.sum() < inside.size
    np.testing.assert_array_equal(model.seen.ravel(), inside)
