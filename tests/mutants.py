# ruff: noqa: E501
"""Mutation check, run by hand: changes one line at a time in a copy of the project and runs the tests that should fail.

    python tests/mutants.py                 # all mutants (hours: each recompiles the kernels that it changes)
    python tests/mutants.py judge 40-45     # mutants whose file contains "judge", and mutants 40 to 45
    python tests/mutants.py --check         # only whether each text to replace still occurs exactly once

A mutant that survives is a fault that no test would notice. The exit status is 1 unless all are
killed.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Mutant(NamedTuple):
    """Change of one text, which occurs once in a file, and the test modules that should notice it, without "test_"."""

    file: str
    old: str
    new: str
    tests: str


MUTANTS = [
    Mutant(*row)
    for row in [
        # core: geometry, interpolation, rays
        ("twin/core/geometry.py", "a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2", "a, b = np.sin(angle) / angle, (1.0 + np.cos(angle)) / angle2", "geometry"),
        ("twin/core/geometry.py", "a, b = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0", "a, b = 0.5 - angle2 / 24.0, 1.0 / 3.0 - angle2 / 120.0", "geometry"),
        ("twin/core/interpolation.py", "c3 = 0.5 * (e - a) + 1.5 * (b - c)", "c3 = 0.5 * (e - a) - 1.5 * (b - c)", "interpolation"),
        ("twin/core/height_field.py", "south_m = grid.north_m - (grid.rows - 0.5) * grid.cell_m", "south_m = grid.north_m - grid.rows * grid.cell_m", "core_image_overlap world_coverage surrogate"),
        ("twin/core/height_field.py", "scale = depth / depth2", "scale = depth2 / depth", "core_image_overlap"),
        ("twin/core/georeference.py", "easting = self.easting + np.asarray(x_m, np.float64) / self.metres_per_unit", "easting = self.easting + np.asarray(x_m, np.float64) * self.metres_per_unit", "terrains_georeference"),
        ("twin/core/records.py", "_WATER_KG_M3 * GRAVITY_MPS2", "_WATER_KG_M3 / GRAVITY_MPS2", "exchange_ros2"),
        ("twin/core/settings.py", "math.exp(-interval_s / BRAKING_S)", "math.exp(-interval_s * BRAKING_S / 2)", "session_mission_actions estimate_motion_filter"),
        ("twin/core/height_field.py", "return np.asarray(east, np.float64), -np.asarray(south, np.float64)", "return np.asarray(east, np.float64), np.asarray(south, np.float64)", "interpolation"),
        # terrains and their objects
        ("terrains/generate.py", "west_m, south_m = -(nx - 1) * grid_m / 2, -(ny - 1) * grid_m / 2", "west_m, south_m = -nx * grid_m / 2, -(ny - 1) * grid_m / 2", "terrains_floor"),
        ("terrains/load.py", "values = given.values[::-1]", "values = given.values", "terrains_load"),
        ("terrains/objects/detail.py", "x, y, z = np.cross(ab, ac).T", "x, y, z = np.cross(ac, ab).T", "imaging_mesh_parts"),
        ("terrains/objects/scattering.py", "np.hypot(east, north) / (2 * reach_m)", "np.hypot(east, north) / reach_m", "world_placement terrains_objects"),
        ("terrains/objects/mesh_file.py", "row = np.minimum(((1 - v) * height)", "row = np.minimum((v * height)", "terrains_objects"),
        # controllers
        ("controllers/lawnmower.py", "(1 - request.overlap_across) * request.footprint_m[0]", "(1 - request.overlap_across) * request.footprint_m[1]", "controllers_lawnmower"),
        ("controllers/loops.py", "loop_diameter_m * math.sin(math.pi / n_filling)", "loop_diameter_m * math.sin(2 * math.pi / n_filling)", "controllers_loops"),
        ("controllers/segments.py", "return peak * (time_s - 0.5 * ramp), peak, 0.0", "return peak * (time_s - ramp), peak, 0.0", "controllers_lawnmower controllers_tracking"),
        ("controllers/survey_area.py", "return c * x + s * y, c * y - s * x", "return c * x - s * y, c * y + s * x", "controllers_area"),
        ("controllers/tracking.py", "Gains(proportional=w**2 + 2 * w * a, derivative=2 * w + a, integral=a * w**2)", "Gains(proportional=w**2 + 2 * w * a, derivative=2 * w + a, integral=a * w)", "controllers_tracking"),
        ("controllers/allocation.py", "return np.interp(thrusts / load, table, allocation.command_table), 1 / load", "return np.interp(thrusts, table, allocation.command_table), 1 / load", "controllers_tracking simulate_hydrodynamics"),
        ("controllers/detours.py", "later * (d.track > leave.track)", "later * (d.track < leave.track)", "controllers_detours"),
        ("controllers/detours.py", "segment._replace(start=(x, y, z + by_m))", "segment._replace(start=(x, y, z - by_m))", "controllers_detours"),
        ("twin/simulate/tether.py", "(1 - share) * tether.drag", "tether.drag", "simulate_tether"),
        ("twin/simulate/tether.py", "wrench[1] += a[2] * force[0] - a[0] * force[2]", "wrench[1] += a[0] * force[2] - a[2] * force[0]", "simulate_tether"),
        ("twin/simulate/faults.py", "camera * rig.baseline_m * px_per_m", "0 * rig.baseline_m * px_per_m", "simulate_faults"),
        ("twin/estimate/vision/inertial_filter.py", "advance[9 + i, 12 + j] -= g[i, j]", "advance[9 + i, 12 + j] += g[i, j]", "estimate_inertial"),
        ("twin/estimate/vision/inertial_filter.py", "geometry.so3_exp(rate * (dt / 2)) @ force", "force", "estimate_inertial"),
        ("twin/world/mission_flight.py", "slope, decay = self.rate_mps + w * self.left_m", "slope, decay = self.rate_mps - w * self.left_m", "world_floor_following"),
        ("twin/world/floor_following.py", "np.cos(angle) + gradient * np.sin(angle)", "np.cos(angle) - gradient * np.sin(angle)", "world_floor_following"),
        ("twin/world/floor_following.py", "sampled(top_m, x, y, 0) + self._clearance_m", "sampled(top_m, x, y, 0) - self._clearance_m", "world_floor_following"),
        ("twin/world/gap_filling.py", "self._asked & (self._n < _LEAST_KEYFRAMES)", "self._asked & (self._n < 1)", "world_gap_filling"),
        ("twin/world/height_floor.py", "np.float32(t.prior_offset_m)", "np.float32(-t.prior_offset_m)", "world_floor_following"),
        ("controllers/survey_plan.py", "per_px = self.altitude_m / self.focal_px", "per_px = self.altitude_m * 2 / self.focal_px", "controllers_lawnmower"),
        # scenes
        ("scenes/builder.py", "mass_kg, np.zeros(3), np.array(inertia_kgm2)", "mass_kg, np.ones(3), np.array(inertia_kgm2)", "scenes_builder"),
        ("twin/imaging/scene/floor_albedo.py", "high - north[u] * per_y", "north[u] * per_y", "imaging_renderer"),
        ("twin/imaging/scene/floor_raster.py", "(q > row[u])", "(q >= 0)", "imaging_renderer"),
        # simulate
        ("twin/simulate/hydrodynamics.py", "(hull.buoyancy_n - hull.weight_n) * up[k]", "(hull.weight_n - hull.buoyancy_n) * up[k]", "simulate_hydrodynamics"),
        ("twin/simulate/hydrodynamics.py", "total[k, k] += hull.inertia[k]", "total[k, k] = hull.inertia[k]", "simulate_hydrodynamics"),
        ("twin/simulate/hydrodynamics.py", "hull.buoyancy_n / GRAVITY_MPS2 * world_from_body", "0.0 * world_from_body", "simulate_sea simulate_hydrodynamics"),
        ("twin/simulate/sea.py", "white * np.sqrt(power)", "white * power", "simulate_sea"),
        ("twin/simulate/waves.py", "flow[4, 2] -= u_x", "flow[4, 2] += u_x", "simulate_sea"),
        ("twin/simulate/faults.py", "start - 1e-9 <= time_s < end - 1e-9", "start - 1e-9 <= time_s <= end", "simulate_faults"),
        ("controllers/current_estimate.py", "through, mass = flow.velocity[k] - current[k], hull.inertia[3 + k]", "through, mass = flow.velocity[k], hull.inertia[3 + k]", "controllers_tracking"),
        ("twin/world/pilot.py", "target = target + late_s * velocity + 0.5 * late_s**2 * acceleration", "target = target + 0.0", "world_latency"),
        ("twin/estimate/navigation/kalman.py", "if not is_disputed or counts[4] < _MANY_PREDICTED:", "if not is_disputed:", "estimate_aiding"),
        ("twin/estimate/pipeline.py", "        self.filter.state = blind.state\n", "", "estimate_blindness"),
        ("twin/simulate/energy.py", "1 - RESERVE) * vehicle.battery_wh", "1 + RESERVE) * vehicle.battery_wh", "planning_vehicle"),
        ("twin/simulate/sensors.py", "height = (up[0] * arm[0] + up[2] * arm[2]) + (up[1] * arm[1] + up[3])", "height = (up[0] * arm[0] - up[2] * arm[2]) + (up[1] * arm[1] + up[3])", "simulate_sensors"),
        ("twin/simulate/sensors.py", "gain = 1 + noise.dvl_scale * float(rng[\"dvl\"].standard_normal())", "gain = 1.0", "simulate_sensors"),
        ("twin/simulate/sensors.py", "self._walk = np.repeat(walks, 3) / math.sqrt(self._rate_hz)", "self._walk = np.repeat(walks, 3) * math.sqrt(self._rate_hz)", "simulate_inertial_sensor"),
        # imaging
        ("twin/imaging/light/caustics.py", "return 0.5 * around_peak * (long + short)", "return 0.5 * around_peak * long", "imaging_caustics"),
        ("twin/imaging/light/caustics.py", "friction if friction <= 0 else 3 * friction", "friction", "imaging_caustics"),
        ("twin/imaging/light/caustics.py", "short = 0.13 * _friction_mps", "short = 0.0 * _friction_mps", "imaging_caustics"),
        ("twin/imaging/camera/shutter.py", "both = ab * ab * np.float32(144 / 80)", "both = ab * ab", "imaging_shutter"),
        ("twin/imaging/camera/shutter.py", "falling[u], rising[u] = (both + ab) * quarter, (both - ab) * quarter", "falling[u], rising[u] = (both - ab) * quarter, (both + ab) * quarter", "imaging_shutter"),
        ("twin/imaging/light/sun_sky.py", "1 - (across**2 + along**2) / 2", "1 - (across**2 + along**2)", "imaging_daylight"),
        ("twin/imaging/light/phase_function.py", "(1 - g**2) / (4 * np.pi * ((1 - g) ** 2 + 4 * g * np.sin(angle / 2) ** 2) ** 1.5)", "(1 - g**2) / (4 * np.pi * ((1 - g) ** 2 + 4 * g * np.sin(angle / 2) ** 2))", "imaging_phase_function"),
        ("twin/imaging/camera/sensor.py", "np.sqrt(read_variance + shot_variance * signal)", "np.sqrt(read_variance + shot_variance)", "imaging_sensor"),
        ("twin/imaging/camera/sensor.py", "self.share = 1 - np.exp(-1 / (frame_rate_hz * lag_s))", "self.share = np.exp(-1 / (frame_rate_hz * lag_s))", "imaging_sensor"),
        ("twin/imaging/camera/lens.py", "3 * lens.k1, 5 * lens.k2, 7 * lens.k3", "3 * lens.k1, 3 * lens.k2, 7 * lens.k3", "imaging_lens"),
        ("twin/imaging/light/backscatter.py", "return total + scattered * np.exp(", "return total + scattered / 2 * np.exp(", "imaging_optics"),
        ("twin/imaging/scene/object_view.py", "vertices[:, 2] -= deflection**2 / (2 * height_m)", "vertices[:, 2] -= deflection**2 / height_m", "imaging_sway"),
        ("twin/imaging/reference/directions.py", "low, high = (k / cells) ** 4, ((k + 1) / cells) ** 4", "low, high = (k / cells) ** 2, ((k + 1) / cells) ** 2", "imaging_reference imaging_photons"),
        # estimators
        ("twin/estimate/vision/motion_filter.py", "[[interval_s**2 / 3, interval_s / 2]", "[[interval_s**2, interval_s / 2]", "estimate_motion_filter"),
        ("twin/estimate/vision/stereo.py", "return measured, joint / rig.focal_px**2", "return measured, joint / rig.focal_px", "estimate_motion estimate_link_noise"),
        ("twin/estimate/vision/stereo.py", "(self.accumulated_cov - earlier.accumulated_cov)", "(self.accumulated_cov + earlier.accumulated_cov)", "estimate_wide_search"),
        ("twin/estimate/vision/epipolar.py", "matrix @ translation / focal_baseline", "matrix @ translation * focal_baseline", "estimate_disparity estimate_depth_filter estimate_motion"),
        ("twin/estimate/vision/light_pattern.py", "np.maximum(1 - variance / np.maximum(mean**2, 1e-12), 0) * mean", "mean", "estimate_light_pattern"),
        ("twin/estimate/mapping/depth_filter.py", "variance = (depth * depth / focal_baseline * disparity.sigma_px) ** 2", "variance = (depth / focal_baseline * disparity.sigma_px) ** 2", "estimate_depth_filter"),
        ("twin/estimate/mapping/depth_filter.py", "gain = p / (p + r)", "gain = r / (p + r)", "estimate_depth_filter"),
        ("twin/estimate/mapping/elevation.py", "_WRONG_CHOICE * (1 - _WRONG_CHOICE)", "_WRONG_CHOICE", "estimate_elevation"),
        ("twin/estimate/mapping/surface.py", "col = (z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3] - west) / cell - 0.5", "col = (z * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3] - west) / cell", "estimate_elevation"),
        ("twin/estimate/navigation/aiding.py", "np.eye(3 - first) * sigma_m**-2", "np.eye(3 - first) * sigma_m**-1", "estimate_aiding"),
        ("twin/estimate/navigation/aiding.py", "np.eye(2) * noise.up_rad**-2 / max(len(index), 1)", "np.eye(2) * noise.up_rad**-2", "estimate_aiding estimate_vertical"),
        ("twin/estimate/navigation/dvl.py", "step[i] = (last[i] + now) / 2 * duration_s", "step[i] = now * duration_s", "estimate_positioning estimate_aiding"),
        ("twin/estimate/navigation/dvl.py", "state.velocity[:], state.gap_s[:] = np.nan, 0.0  # vision", "state.gap_s[:] = 0.0  # vision", "estimate_late_readings"),
        ("twin/estimate/navigation/pose_filter.py", "before = cov - clip_covariance(motion_cov, cov, 0.0, 1.0)", "before = cov", "estimate_late_readings"),
        ("twin/estimate/late_readings.py", "at = int(np.searchsorted(times_s, time_s - _SAME_S))", "at = int(np.searchsorted(times_s, time_s - _SAME_S)) + 1", "estimate_late_readings"),
        ("twin/simulate/reading_times.py", "self._waiting.append((time_s + delay_s, time_s,", "self._waiting.append((time_s + delay_s, time_s + delay_s,", "simulate_sensors"),
        ("twin/simulate/echo_sounders.py", "np.full(4, -np.cos(tilt))", "np.full(4, -1.0)", "simulate_sensors"),
        ("twin/estimate/self_check.py", "cov[:, 3:, 3:] += of_positions**2", "cov[:, 3:, 3:] += of_positions", "estimate_self_check"),
        ("twin/judge/recorded.py", "used = used[1:] if alignment == \"first\" else used", "used = used", "judge_recorded"),
        ("twin/estimate/navigation/dvl.py", "growth, cov = (2 * state.path_m[0] + length) / length,", "growth, cov = (state.path_m[0] + length) / length,", "estimate_positioning estimate_aiding"),
        ("twin/estimate/navigation/pose_filter.py", "[[1, 0, -x / depth], [0, 1, -y / depth]]", "[[1, 0, x / depth], [0, 1, -y / depth]]", "estimate_positioning estimate_aiding"),
        ("twin/estimate/navigation/vertical.py", "up = ahead * information[0][:, None] + back[::-1] * information[1][:, None]", "up = ahead * information[1][:, None] + back[::-1] * information[0][:, None]", "estimate_vertical"),
        ("twin/estimate/adjustment/pose_graph.py", "damping / 10 if damping > _MIN_DAMPING else 0.0", "damping * 10 if damping > _MIN_DAMPING else 0.0", "estimate_pose_graph"),
        ("twin/estimate/adjustment/pose_graph.py", 'shared = cov @ (-equations.shared_gradient - np.einsum("nak,na->k", equations.border, poses))', "shared = cov @ -equations.shared_gradient", "estimate_pose_graph estimate_aiding"),
        ("twin/estimate/link_selection.py", "return 1 / (1 - min(overlap, _LARGEST_OVERLAP))", "return 1 / (2 - min(overlap, _LARGEST_OVERLAP))", "estimate_positioning"),
        ("twin/estimate/self_check.py", "quality.frames_lost / max(n, 1), MAX_FRAMES_LOST", "quality.frames_lost / max(2 * n, 1), MAX_FRAMES_LOST", "estimate_self_check"),
        # judge
        ("twin/judge/consistency.py", "error, cov = np.einsum(\"nji,nj->ni\"", "error, cov = np.einsum(\"nij,nj->ni\"", "judge_metrics judge_trajectory"),
        ("twin/judge/consistency.py", "tail = (1 - CONSISTENT_SHARE) / 2", "tail = 1 - CONSISTENT_SHARE", "judge_metrics judge_trajectory"),
        ("twin/judge/map_error.py", "1.4826 * np.median(np.abs(error - np.median(error)))", "1.4826 * np.median(np.abs(error))", "judge_metrics judge_true_map"),
        ("twin/judge/map_error.py", "percent, method=\"higher\")", "percent, method=\"lower\")", "judge_area judge_metrics"),
        ("twin/judge/trajectory_errors.py", "return first_true @ geometry.inverse(first_estimated)", "return first_estimated @ geometry.inverse(first_true)", "judge_trajectory"),
        ("twin/judge/orthomosaic_errors.py", "hue = np.where(coloured, (h1 + h2) / 2 + across, h1 + h2)", "hue = np.where(coloured, (h1 + h2) / 2, h1 + h2)", "judge_metrics orthomosaic"),
        ("twin/judge/verdict.py", "(abs(value) if name in SIGNED else value) <= limit", "(abs(value) if name in SIGNED else value) < limit", "judge_metrics"),
        # exchange
        ("twin/datasets/ros2/bag_writer.py", "return air_pa + PASCAL_PER_METRE * (surface_m - height_m)", "return air_pa + PASCAL_PER_METRE * (height_m - surface_m)", "exchange_ros2"),
        ("twin/exchange/geotiff.py", "cell = grid.cell_m / origin.metres_per_unit", "cell = grid.cell_m * origin.metres_per_unit", "world_placement"),
        ("twin/exports/geographic_place.py", "float(np.rad2deg(yaw)) % 360.0, float(np.rad2deg(pitch)), float(np.rad2deg(roll))", "float(np.rad2deg(yaw)) % 360.0, float(np.rad2deg(roll)), float(np.rad2deg(pitch))", "exchange_datasets"),
        # plug-ins, world, surrogate, sessions
        ("twin/plugin/guard.py", "max(error, turned) > _ROTATION_TOLERANCE", "error > _ROTATION_TOLERANCE", "plugin_guard"),
        ("twin/plugin/guard.py", "function(*copy.deepcopy(arguments))", "function(*arguments)", "plugin_guard"),
        ("twin/world/planning.py", "(duration_s + hold_s * plan.n_tracks)", "(duration_s + hold_s)", "world_planning"),
        ("twin/world/path_checks.py", "2 * int(reach_m * side / terrain.spacing_m) + 1", "2 * int(reach_m * side / terrain.spacing_m / 8) + 1", "world_slopes"),
        ("twin/world/planning.py", "extent = height_m / request.altitude_m /", "extent = height_m**0 /", "world_slopes"),
        ("controllers/camera_surface.py", "self.max_climb * run_m / rise_m", "2 * self.max_climb * run_m / rise_m", "world_slopes"),
        ("twin/surrogate/sampling.py", "(normals[k] - errors.anticorrelation * previous_normals[k])", "(normals[k] + errors.anticorrelation * previous_normals[k])", "surrogate"),
        ("twin/surrogate/height_errors.py", "/ np.sqrt(1 + gain * (cells.views - 1))", "/ np.sqrt(1 + gain * cells.views)", "surrogate_map"),
        ("twin/session/mission_actions.py", "change_per_s = (target - self._rate) / BRAKING_S", "change_per_s = (target - self._rate) * 4 / BRAKING_S", "session_mission_actions"),
        ("twin/session/survey_check.py", "MAX_OFF_COURSE * min(mission.plan.request.footprint_m)", "MAX_OFF_COURSE * max(mission.plan.request.footprint_m)", "session_survey_check"),
        ("twin/gym.py", "velocity = np.array([c * forward - s * left, s * forward + c * left, up])", "velocity = np.array([c * forward + s * left, s * forward - c * left, up])", "gym"),
        # report
        ("twin/report/number_formats.py", "f\"{1e3 * math.radians(value_deg):.2g} mrad\"", "f\"{math.radians(value_deg):.2g} mrad\"", "report_comparison report_figures"),
        ("twin/report/headline.py", "'at least' if more_is_better(name) else 'at most'", "'at most' if more_is_better(name) else 'at least'", "report_verdict"),
        # data sets, surrogate's fit, studies, app, reproduction
        ("twin/recordings/recorded_aiding.py", "return geometry.so3_exp(axis * np.arctan2(sine, up[2])) @ over_plane", "return geometry.so3_exp(-axis * np.arctan2(sine, up[2])) @ over_plane", "datasets_aiding"),
        ("twin/datasets/sensor_folders.py", "times_s, values = table[:, 0] * 1e-9,", "times_s, values = table[:, 0] * 1e-6,", "datasets_readings"),
        ("twin/studies/statistics.py", "centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)", "centre = (p + z**2 / n) / (1 + z**2 / n)", "study_statistics"),
        ("twin/studies/surveys.py", "0 if plan.paired else sample.point * plan.seeds", "sample.point * plan.seeds if plan.paired else 0", "study_sampling study_runner"),
        ("twin/studies/agreement.py", "within = 1 / (1 + MEDIAN_LIMIT) <= self.ratio.value", "within = 1 - MEDIAN_LIMIT <= self.ratio.value", "study_agreement"),
        ("twin/studies/monotone.py", "np.minimum(after, required)", "after", "study_monotone"),
        ("twin/studies/answers.py", "shapes if same[0] != same[1] else shapes[:1]", "shapes[1:]", "study_answers"),
        ("twin/tuning/verification.py", "self.probability.low >= self.required", "self.probability.value >= self.required", "study_verification"),
        ("twin/tuning/correction.py", "math.exp(-0.5 * (plan_distance", "math.exp(0.5 * (plan_distance", "study_rendered_check study_tuning study_verification"),
        ("twin/planning/cost.py", "n_frames * frame + n_keyframes *", "n_frames * frame - n_keyframes *", "app_plan"),
        ("twin/planning/expected_error.py", "float(np.mean(2 * ndtr(x / self.sigma_m) - 1)) - share", "float(np.mean(ndtr(x / self.sigma_m))) - share", "app_plan"),
        ("twin/reproduce/tank_sizes.py", "share = np.sqrt(3) / 2 if item.shape == \"dome\"", "share = 0.5 if item.shape == \"dome\"", "reproduce_tank"),
        # self-calibration, rigs, interrupts
        ("twin/estimate/vision/observation_equations.py", "-x * points[i, 1] / 2, 1 + x * x", "x * points[i, 1] / 2, 1 + x * x", "estimate_self_calibration"),
        ("twin/estimate/vision/two_view_motion.py", "variance**0.5, -by_unknowns[:6]", "variance**0.5, by_unknowns[:6]", "estimate_self_calibration"),
        ("twin/estimate/self_calibration.py", 'np.einsum("nji,nj->ni", rotation, moved)', 'np.einsum("nij,nj->ni", rotation, moved)', "estimate_self_calibration"),
        ("twin/estimate/adjustment/pose_graph.py", "derivatives, shared - at)", "derivatives, shared + 0 * at)", "estimate_self_calibration"),
        ("twin/estimate/mapping/map_builder.py", "stereo.disparity_px - offset_px", "stereo.disparity_px + offset_px", "estimate_self_calibration"),
        ("twin/estimate/vision/pair_matching.py", "points = points - remaining * ", "points = points + remaining * ", "estimate_self_calibration"),
        ("twin/estimate/vision/rolling_shutter.py", "(rig.height_px - 1) - 0.5)", "(rig.height_px - 1) + 0.5)", "estimate_rolling_shutter"),
        ("twin/surrogate/vision.py", "gain = self._tracked_view.motion_gain", "gain = self.view.motion_gain", "surrogate"),
        ("twin/surrogate/matchability.py", "motion = sensor.motion(self._twist, setting, len(view.depth))", "motion = None", "surrogate"),
        ("twin/imaging/camera/photo_sensor.py", "self._delivered = self._vignetting * self._flat", "self._delivered = self._vignetting", "imaging_photons"),
        ("twin/core/refraction.py", "(1 / depth_m - 1 / self.rectified_m)", "(1 / depth_m + 1 / self.rectified_m)", "core_refraction"),
        ("twin/core/resample.py", "np.float32(1 / sum_of_powers)", "np.float32(1.0)", "imaging_ray_sampling"),
        ("twin/studies/analysis.py", "self.unknown = self.unmodelled | self.failed", "self.unknown = self.unmodelled", "study_report"),
        ("twin/scenario/model.py", "np.random.SeedSequence(self.seed, spawn_key", "np.random.SeedSequence(0, spawn_key", "scenario_rigs"),
        ("twin/core/interrupts.py", "error = error.__cause__ or error.__context__", "error = None", "interrupts"),
    ]
]  # fmt: skip


def chosen(words):
    """Returns the (number, mutant) pairs that the words name: parts of file names, numbers, or ranges of numbers."""
    numbers = {
        number
        for first, last in re.findall(r"(?<!\S)(\d+)(?:-(\d+))?(?!\S)", " ".join(words))
        for number in range(int(first), int(last or first) + 1)
    }
    parts = [word for word in words if not word[0].isdigit()]
    return [
        (number, mutant)
        for number, mutant in enumerate(MUTANTS, 1)
        if not words or number in numbers or any(part in mutant.file for part in parts)
    ]


def is_current(mutant):
    file = ROOT / mutant.file
    return file.is_file() and file.read_text(encoding="utf-8").count(mutant.old) == 1


def verdict_on(mutant):
    """Returns "killed", "survived", "out of date", or "broken" where the tests fail without the mutant too."""
    if not is_current(mutant):
        return "out of date"
    if not tests_pass(mutant.tests):
        return "broken"
    return "survived" if tests_pass(mutant.tests, mutant) else "killed"


@cache
def tests_pass(tests, mutant=None):
    """Returns whether test modules pass in a copy of the project, with a mutant if one is given."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "project"
        shutil.copytree(
            ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", ".*_cache")
        )
        if mutant:
            file = copy / mutant.file
            file.write_text(file.read_text(encoding="utf-8").replace(mutant.old, mutant.new), encoding="utf-8")
        modules = [f"tests/test_{name}.py" for name in tests.split()]
        data = os.environ.get("TWIN_DATA", str(ROOT / "../shared/data"))
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-m", "not slow", "--basetemp", folder + "/tmp", *modules],
            cwd=copy, env=os.environ | {"PYTHONPATH": str(copy), "TWIN_DATA": data}, capture_output=True, text=True,
        )  # fmt: skip
    if done.returncode not in (0, 1):
        sys.exit(done.stdout + done.stderr)
    return done.returncode == 0


def main(words):
    verdict = (lambda one: "current" if is_current(one) else "out of date") if "--check" in words else verdict_on
    bad = 0
    for number, mutant in chosen([word for word in words if word != "--check"]):
        found = verdict(mutant)
        bad += found not in ("killed", "current")
        print(f"{number:3} {found:12} {mutant.file}: {mutant.old}  ->  {mutant.new}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
