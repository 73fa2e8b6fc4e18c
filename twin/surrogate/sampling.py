"""Sampling of measured motions (compiled): between frames, between keyframes, and relative to the mosaic."""

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.vision import observation_equations
from twin.estimate.vision.observation_equations import change_by_yaw
from twin.estimate.vision.two_view_motion import CUTOFF, HUBER
from twin.kernels import kernel
from twin.surrogate.measured_view import measure_point

MIN_POINTS = 6  # smallest number of points from which a motion is estimated
_MORE_ITERATIONS = 5  # further least-squares iterations of a link if points are not measured at their true positions


@kernel
def sample_f2f_motion(errors, previous_pose, pose, normals, previous_normals):
    """Samples the motion previous_from_current (4, 4) between true poses; normals (6,) for it and the one before."""
    error = np.zeros(6)
    for i in range(6):
        for k in range(6):
            error[i] += errors.root[i, k] * (normals[k] - errors.anticorrelation * previous_normals[k])
    motion = geometry.compose(geometry.inverse(previous_pose), pose)
    if errors.gain.size:
        motion = geometry.exp(errors.gain @ geometry.log(motion))
    return geometry.compose(motion, geometry.exp(error))


@kernel
def sample_links(
    points, later_noise, earlier_noises, relief_noise, normals, earlier_poses, later_pose, camera, unit_cov, variances,
    unit_root, sigmas, bias_fraction, relief_sigmas, distance_growth, common_sigma, noise_shares,
):  # fmt: skip
    """Samples the motions between a keyframe and m earlier ones: `sample_link` for each, with arrays of m items.

    The reported covariances of a point are `unit_cov` times `variances` (m,), the factors of the true ones `unit_root`
    times `sigmas` (m,). Returns arrays of the results of `sample_link`: (m,), (m, 4, 4), (m, 6, 6) and (m, 8).
    """
    m = len(earlier_poses)
    counts, motions, covs, yaws = np.empty(m, np.int64), np.empty((m, 4, 4)), np.empty((m, 6, 6)), np.empty((m, 8))
    for k in range(m):
        counts[k], motions[k], covs[k], yaws[k] = sample_link(
            points, later_noise, earlier_noises[k], relief_noise, normals[k], earlier_poses[k], later_pose, camera,
            unit_cov * variances[k], unit_root * sigmas[k], bias_fraction, relief_sigmas[k], distance_growth,
            common_sigma, noise_shares[k],
        )  # fmt: skip
    return counts, motions, covs, yaws


@kernel
def sample_link(
    points, later_noise, earlier_noise, relief_noise, normals, earlier_pose, later_pose, camera, cov, error_root,
    bias_fraction, relief_sigma, distance_growth, common_sigma, noise_share,
):  # fmt: skip
    """Samples the motion between two keyframes: estimates it from points with sampled noise, as from matched points.

    Standard deviations and covariances are in normalised coordinates. The true `points` (n, 3) of the later keyframe
    are normalised (x, y, disparity), the true poses (4, 4). `camera` is focal length, principal point x and y, image
    width and height, margin along the border [px]; baseline [m]; table of the measured positions of true points
    (`measured_view.ViewTable`).

    Standard normal samples: `later_noise` (n, 3) of the later pair's errors at these points; `earlier_noise` (rows,
    cols, 3) of the earlier pair's biases, on a raster over its image; `relief_noise` (f, f, 2) of the errors due to
    relief, repeated every f floor cells; `normals` (n + 1, 3) of this link alone: its points, and the last one for the
    bias of deviation `common_sigma` that they share.

    A point has in either pair the reported covariance `cov` (3, 3) and the Cholesky factor `error_root` (3, 3) of the
    true one, whose variance in the earlier pair grows by `distance_growth` with distance / depth. `noise_share` is the
    number of points divided by that of the matches they represent: the variance of the mean of independent matches that
    a point represents, divided by that of a single match.

    Returns the number of points that both keyframes see; motion earlier_from_later (4, 4), its reported covariance (6,
    6), and the yaw of the right camera as `_yaw` gives it. The latter are valid only if at least `MIN_POINTS` are seen.
    """
    focal, cx, cy, width, height, margin, baseline, table = camera
    earlier_from_later, bias = geometry.inverse(earlier_pose) @ later_pose, normals[-1] * common_sigma
    transferred, _, _ = observation_equations.transfer(points, earlier_from_later, baseline)
    inverse_depth = np.mean(points[:, 2]) / baseline
    distance = inverse_depth * earlier_from_later[:3, 3]  # in units of depth
    cell_m = width / focal / earlier_noise.shape[1] / inverse_depth
    n, growth = 0, distance_growth**2 * np.sum(distance**2)
    independent = np.sqrt(1 - bias_fraction * bias_fraction + growth)
    a, b = np.empty_like(points), np.empty_like(points)
    for k in range(len(points)):
        seen = measure_point(table, transferred[k, 0], transferred[k, 1], transferred[k, 2])
        later = measure_point(table, points[k, 0], points[k, 1], points[k, 2])
        u, v = seen[0] * focal + cx, seen[1] * focal + cy
        if margin <= u < width - margin and margin <= v < height - margin and u - focal * seen[2] >= margin:
            pair_bias = earlier_noise[int(v / height * earlier_noise.shape[0]), int(u / width * earlier_noise.shape[1])]
            row, col = _floor_cell(later_pose, points[k], baseline, cell_m, len(relief_noise))
            cross, along = relief_sigma * relief_noise[row, col, 0], relief_sigma * relief_noise[row, col, 1]
            for r in range(3):
                a[n, r], b[n, r] = seen[r] + bias[r], later[r]
                for c in range(r + 1):
                    a[n, r] += error_root[r, c] * (bias_fraction * pair_bias[c] + independent * normals[k, c])
                    b[n, r] += error_root[r, c] * later_noise[k, c]
            a[n, 0] += distance[1] * cross
            a[n, 1] += distance[0] * cross + 2 * distance[1] * along
            n += 1
    a, b, earlier_cov = a[:n], b[:n], cov * (1 + growth)
    later_covs, earlier_covs = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for k in range(n):
        geometry.copy_into(later_covs[k], cov)
        geometry.copy_into(earlier_covs[k], earlier_cov)
    measured = observation_equations.PairMeasurements(a, b, earlier_covs, later_covs)
    weight = np.ones(n)
    observations = observation_equations.linearise(measured, b, earlier_from_later, baseline)
    normal, right, bias_jacobian = observation_equations.motion_normal_equations(observations, weight)
    if n < MIN_POINTS or min(np.ptp(b[:, 0]), np.ptp(b[:, 1])) * focal < 1:  # points in a line determine no motion
        return min(n, MIN_POINTS - 1), earlier_from_later, normal, np.zeros(8)
    inverse = np.linalg.inv(normal)
    motion = earlier_from_later @ geometry.exp(inverse @ right)
    for _ in range(_MORE_ITERATIONS if table.values.size or table.yaw_rad else 0):
        observations = observation_equations.linearise(measured, b, motion, baseline)
        weight = _robust_weights(observations.normalised_residual, noise_share)
        normal, right, bias_jacobian = observation_equations.motion_normal_equations(observations, weight)
        if np.count_nonzero(weight) < MIN_POINTS:
            break
        inverse = np.linalg.inv(normal)
        motion = motion @ geometry.exp(inverse @ right)
    common = inverse @ bias_jacobian * common_sigma
    yaw = _yaw(observations, weight, inverse, right, change_by_yaw(a), change_by_yaw(b))
    return n, motion, inverse + common @ common.T, yaw


@kernel
def _yaw(observations, weight, inverse, right, change_a, change_b):
    """Returns yaw of the right camera, standard deviation (inf: not observable) and effect (6,) on the motion, (8,)."""
    # see `two_view_motion.YawEffect`
    coupling, information, score = np.zeros(6), 0.0, 0.0
    for k in range(len(weight)):
        derivative = change_a[k] - observations.jacobian_point[k] @ change_b[k]
        weighted = weight[k] * (observations.information[k] @ derivative)
        coupling += observations.jacobian_motion[k].T @ weighted
        information += np.sum(weighted * derivative)
        score += np.sum(weighted * observations.residual[k])
    by_motion, found = inverse @ coupling, np.zeros(8)
    remaining = information - np.sum(coupling * by_motion)
    found[1], found[2:] = np.inf, -by_motion
    if remaining > 1e-9 * information:
        found[0], found[1] = (score - np.sum(by_motion * right)) / remaining, remaining**-0.5
    return found


@kernel
def _robust_weights(normalised_residual, noise_share):
    """Returns approximate weights (n,) of single matches in `two_view_motion.pair_motion`: Huber, 0 beyond a cutoff."""
    size = np.sqrt(1 + noise_share * normalised_residual**2)
    scale = np.median(size)
    return np.minimum(1.0, HUBER * scale / size) * (size < CUTOFF * scale)


@kernel(inline="always")
def _floor_cell(pose, point, baseline, cell_m, n):
    """Returns row and column (modulo n) of the floor cell of a point (x, y, disparity) in a camera at `pose`."""
    depth = baseline / point[2]
    x = pose[0, 3] + depth * (pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2])
    y = pose[1, 3] + depth * (pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2])
    return int(np.floor(y / cell_m)) % n, int(np.floor(x / cell_m)) % n


@kernel
def unit_motion_cov(points: Array, baseline: float, n_effective: float) -> Array:
    """Returns the covariance (6, 6) of a motion estimated from flow and known depth."""
    # least squares, Negahdaripour & Madjidi (2003), eq. (2), from `n_effective` flow vectors of unit standard
    # deviation, distributed over image and depth as `points` (n, 3), normalised (x, y, disparity)
    n = len(points)
    jacobian = observation_equations.image_jacobian(points[:, 0], points[:, 1], baseline / points[:, 2])
    normal, _ = observation_equations.normal_equations(jacobian, np.full(n, n_effective / n), np.zeros((n, 2)))
    return np.ascontiguousarray(np.linalg.inv(normal))  # pyright: ignore[reportReturnType]


@kernel
def measured_motion(points, earlier_pose, later_pose, camera, cov):
    """Returns the motion earlier_from_later (4, 4) that is estimated from points without noise; see `sample_link`."""
    # the true one if all points are measured at their true positions, or if too few of them are in both views
    if not camera[-1].values.size and camera[-1].yaw_rad == 0:
        return geometry.inverse(earlier_pose) @ later_pose
    noise, cells, normals = np.zeros(points.shape), np.zeros((1, 1, 3)), np.zeros((len(points) + 1, 3))
    return sample_link(
        points, noise, cells, np.zeros((1, 1, 2)), normals, earlier_pose, later_pose, camera, cov, np.zeros((3, 3)),
        0.0, 0.0, 0.0, 0.0, 1.0,
    )[1]  # fmt: skip


@kernel
def mosaic_correction(estimated, measured_motions, fractions, predicted_pose):
    """Returns the correction (6,) of a predicted pose by a registration with the mosaic without matching errors."""
    # each keyframe is displaced by the error of the pose at which it was added: their mean over those in view by
    # `MosaicView.fractions`, given poses (n, 4, 4) of the frame relative to each, without matching errors
    predicted_from_world, correction = geometry.inverse(predicted_pose), np.zeros(6)
    for k in range(len(fractions)):
        in_mosaic = estimated[k] @ measured_motions[k]
        correction += fractions[k] * geometry.log(predicted_from_world @ in_mosaic)
    return correction
