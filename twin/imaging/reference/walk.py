"""Compiled random walks of light, traced backwards from a pixel: the kernel of the reference.

The radiance of a pixel is the integral over all paths from lamps and sun (Veach 1997; Mobley 1994). A walk starts at
the floor point of the pixel at the range r, with the share exp(-c r), or at a first scattering before the floor. Each
vertex is connected in two ways to each lamp of intensity I at the distance d:

* directly: rho/pi cos I/d^2 exp(-c d) at the floor, p I/d^2 exp(-c d) in the water;
* by one more scattering. With the scattering angle t = alpha + beta, alpha and beta at vertex and lamp, the volume
element divided by both squared distances is (1/d) d(alpha) d(t) d(azimuth). With t sampled in proportion to p(t) t, and
alpha uniformly up to t, the weight has neither the peak of p nor poles (compare Georgiev et al. 2013).

Light of a lamp first scattered in the water is sampled by the second connection and by the walk, weighted by
`share_of_walk`; a sun with a disc likewise. The sky is sampled by walks that leave the water. The next direction is
sampled from a mixture: phase function or Lambert's cosine, lobes around lamps and sun, and the upper hemisphere.
Absorption reduces the weight; Russian roulette ends weak walks; no contribution is clipped.

The `axis` of a vertex is what its response depends on: the unit normal of the floor, or, in the water, the unit
direction in which the backward path arrived.
"""

import numpy as np

from twin.core.height_field import cast_ray
from twin.imaging.reference.directions import (
    density_at,
    guide_density,
    sample_angle,
    sample_cosine,
    sample_guide,
    turn,
    turn_by_cosine,
)
from twin.imaging.reference.floor_crossings import LIFT_M, floor_normal, sees
from twin.kernels import kernel

#: Indices of the sums to which `walk` adds light; the bins of the blurred light start at FIRST_BIN.
DIRECT, LAMP_SCATTERED, VEIL_ONCE, VEIL_MORE, FIRST_BIN = 0, 1, 2, 3, 4
GUIDED_AT_FLOOR, GUIDED_IN_WATER = 0.5, 0.05  # shares of the directions that are sampled around lamps and sun
UPWARDS = 0.1  # share of the directions that are sampled upwards, for downward walks in water with daylight
#: Kinds of vertices, and of ends of a path. For `int` arguments, numba would compile a function once for each value.
ON_FLOOR, IN_WATER, ABOVE, NOWHERE = np.int64(0), np.int64(1), np.int64(2), np.int64(3)
WEAK, STEPS = 0.002, 10000  # share of the first weight below which Russian roulette starts; most vertices of a walk


@kernel
def beam_at(beam, cosine):
    """Returns the relative intensity of a lamp at the cosine of the angle from its axis; 0 beyond 90 deg."""
    if cosine <= 0:
        return 0.0
    at = np.arccos(min(cosine, 1.0)) / (np.pi / 2) * (beam.shape[0] - 1)
    k = min(int(at), beam.shape[0] - 2)
    return beam[k] + (at - k) * (beam[k + 1] - beam[k])


@kernel
def response(scene, kind, axis, ox, oy, oz):
    """Returns the share of the light from the direction o that a vertex sends back along the path [1/sr]."""
    cosine = axis[0] * ox + axis[1] * oy + axis[2] * oz
    if kind == ON_FLOOR:
        return scene.albedo / np.pi * max(cosine, 0.0)
    return density_at(scene.phase.density_per_sr, cosine)


@kernel(inline="always")
def towards(lamp, point):
    x, y, z = lamp[0] - point[0], lamp[1] - point[1], lamp[2] - point[2]
    d = np.sqrt(x * x + y * y + z * z)
    return x / d, y / d, z / d, d


@kernel
def straight(scene, kind, point, axis, before, density, step_m):
    """Returns the unscattered light of all lamps at a vertex, times its `response` [cd/m2]."""
    # weighted by `share_of_walk` if the direction from `before` was sampled with a `density` [1/sr] above 0
    total, attenuation = 0.0, scene.absorption + scene.scattering
    for k in range(scene.lamps.shape[0]):
        lamp = scene.lamps[k]
        x, y, z, d = towards(lamp, point)
        if d <= scene.lamp_radius_m:
            continue
        light = lamp[6] * beam_at(scene.beams[k], -(x * lamp[3] + y * lamp[4] + z * lamp[5]))
        light *= response(scene, kind, axis, x, y, z)
        if light > 0 and sees(scene.relief, point, (lamp[0], lamp[1], lamp[2])):
            light *= np.exp(-attenuation * d) / (d * d)
            if density > 0:
                a, b, c = lamp[0] - before[0], lamp[1] - before[1], lamp[2] - before[2]
                phase = density_at(scene.phase.density_per_sr, axis[0] * x + axis[1] * y + axis[2] * z)
                light *= share_of_walk(scene, np.sqrt(a * a + b * b + c * c), phase, d, density, step_m)
            total += light
    return total


@kernel
def by_one_scattering(scene, kind, point, axis, guided, rng):
    """Returns an estimate of lamp light after one scattering, times `response` and 1 - `share_of_walk` [cd/m2]."""
    total, attenuation = 0.0, scene.absorption + scene.scattering
    for k in range(scene.lamps.shape[0]):
        lamp = scene.lamps[k]
        x, y, z, d = towards(lamp, point)
        if d <= scene.lamp_radius_m:
            continue
        angle = sample_angle(scene.phase.cumulative_angle, rng)
        alpha = angle * rng.random()
        sine = np.sin(angle)
        if sine <= 0:
            continue
        from_point, from_lamp = d * np.sin(angle - alpha) / sine, d * np.sin(alpha) / sine
        if from_lamp <= scene.lamp_radius_m:
            continue
        ox, oy, oz = turn(x, y, z, np.cos(alpha), np.sin(alpha), 2 * np.pi * rng.random())
        own = response(scene, kind, axis, ox, oy, oz)
        if own <= 0:
            continue
        px, py, pz = point[0] + from_point * ox, point[1] + from_point * oy, point[2] + from_point * oz
        if pz >= scene.surface_m:
            continue
        bx, by, bz = (px - lamp[0]) / from_lamp, (py - lamp[1]) / from_lamp, (pz - lamp[2]) / from_lamp
        light = own * lamp[6] * beam_at(scene.beams[k], bx * lamp[3] + by * lamp[4] + bz * lamp[5])
        between, source = (px, py, pz), (lamp[0], lamp[1], lamp[2])
        if light > 0 and sees(scene.relief, point, between) and sees(scene.relief, between, source):
            scale = 2 * np.pi * scene.phase.angle_integral * scene.scattering / d
            scale *= np.exp(-attenuation * (from_point + from_lamp))
            density = direction_density(scene, kind, point, axis, guided, own, ox, oy, oz)
            phase = density_at(scene.phase.density_per_sr, np.cos(angle))
            total += scale * light * (1 - share_of_walk(scene, d, phase, from_lamp, density, from_point))
    return total


@kernel
def sunlight(scene, kind, point, axis, guided, rng):
    """Returns the unscattered sunlight at a vertex, times its `response` [cd/m2]."""
    # In water, a random point of the disc is weighted by 1 - `share_of_escape`; at the floor, all comes from its
    # centre.
    sx, sy, sz = scene.to_sun[0], scene.to_sun[1], scene.to_sun[2]
    if scene.sun_lx <= 0 or point[2] >= scene.surface_m:
        return 0.0
    has_disc = kind == IN_WATER and scene.sun_cosine < 1
    if has_disc:
        sx, sy, sz = turn_by_cosine(sx, sy, sz, 1 - rng.random() * (1 - scene.sun_cosine), rng)
    if sz <= 0 or cast_ray(scene.relief, point[0], point[1], point[2], sx, sy, sz) < np.inf:
        return 0.0
    path = (scene.surface_m - point[2]) / sz
    own = response(scene, kind, axis, sx, sy, sz)
    light = scene.sun_lx * np.exp(-(scene.absorption + scene.scattering) * path) * own
    if has_disc:
        density = direction_density(scene, kind, point, axis, guided, own, sx, sy, sz)
        light *= 1 - share_of_escape(scene, density, path)
    return light


@kernel
def share_of_escape(scene, density, path_m):
    """Returns the weight of the walk's estimate of the sun's disc (balance heuristic) for its density [1/sr]."""
    by_walk = density * np.exp(-scene.scattering * path_m)
    by_connection = 1 / (2 * np.pi * (1 - scene.sun_cosine))
    return by_walk / (by_walk + by_connection)


@kernel
def light_above(scene, from_water, density, path_m, x, y, z):
    """Returns the radiance below the surface from the direction (x, y, z); the disc counts after the water only."""
    last = scene.sky.shape[0] - 1
    light = 0.0
    if last > 0:
        at = min(max(z, 0.0), 1.0) * last
        k = min(int(at), last - 1)
        light = scene.sky[k] + (at - k) * (scene.sky[k + 1] - scene.sky[k])
    if from_water and scene.sun_lx > 0 and scene.sun_cosine < 1:
        if x * scene.to_sun[0] + y * scene.to_sun[1] + z * scene.to_sun[2] >= scene.sun_cosine:
            disc = scene.sun_lx / (2 * np.pi * (1 - scene.sun_cosine))
            light += disc * share_of_escape(scene, density, path_m)
    return light


@kernel
def axis_of(scene, k, point):
    """Returns the unit direction from a point to lamp k; to the sun if k is the number of lamps."""
    if k == scene.lamps.shape[0]:
        return scene.to_sun[0], scene.to_sun[1], scene.to_sun[2]
    x, y, z, _ = towards(scene.lamps[k], point)
    return x, y, z


@kernel(inline="always")
def upward_share(scene, kind, axis, guided):
    """Returns the share of directions sampled upwards, among those that are not sampled around a lamp or the sun."""
    sunny = scene.sun_lx > 0 or scene.sky.shape[0] > 1
    return UPWARDS if sunny and kind == IN_WATER and guided > 0 and axis[2] < 0 else 0.0


@kernel
def next_direction(scene, kind, point, axis, guided, rng):
    """Returns the next direction of a walk, sampled from the mixture of `direction_density`."""
    n = scene.lamps.shape[0] + (1 if scene.sun_lx > 0 else 0)
    if n > 0 and rng.random() < guided:
        x, y, z = axis_of(scene, min(int(n * rng.random()), n - 1), point)
        x, y, z = turn_by_cosine(x, y, z, sample_guide(scene.phase.cumulative_angle, rng), rng)
    elif kind == ON_FLOOR:
        x, y, z = turn_by_cosine(axis[0], axis[1], axis[2], np.sqrt(rng.random()), rng)
    elif rng.random() < upward_share(scene, kind, axis, guided):
        x, y, z = turn_by_cosine(0.0, 0.0, 1.0, np.sqrt(rng.random()), rng)
    else:
        cosine = sample_cosine(scene.phase.cumulative, rng)
        x, y, z = turn_by_cosine(axis[0], axis[1], axis[2], cosine, rng)
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@kernel
def direction_density(scene, kind, point, axis, guided, own, x, y, z):
    """Returns the density [1/sr] of `next_direction` at (x, y, z), whose response at the vertex is `own`."""
    # `own`: density of the phase function or, divided by the albedo, of Lambert's cosine
    own = own / scene.albedo if kind == ON_FLOOR else own
    upwards = upward_share(scene, kind, axis, guided)
    if upwards > 0:
        own = (1 - upwards) * own + upwards * max(z, 0.0) / np.pi
    n = scene.lamps.shape[0] + (1 if scene.sun_lx > 0 else 0)
    if n == 0 or guided == 0:
        return own
    lobes = 0.0
    for k in range(n):
        a, b, c = axis_of(scene, k, point)
        cosine = a * x + b * y + c * z
        lobes += guide_density(scene.phase.density_per_sr, scene.phase.beyond, scene.phase.angle_integral, cosine) / n
    return (1 - guided) * own + guided * lobes


@kernel
def share_of_walk(scene, lamp_m, phase, to_lamp_m, density, step_m):
    """Returns the weight of the walk's estimate of the light that leaves a lamp and is first scattered at a point.

    The walk and `by_one_scattering` sample the point with the densities per volume w and s; the weights are w / (w + s)
    and s / (w + s) (balance heuristic, Veach 1997, section 9.2.2), without the common factor 1 / step_m^2.
    """
    by_walk = density * scene.scattering * np.exp(-scene.scattering * step_m)
    by_connection = phase * lamp_m / (2 * np.pi * scene.phase.angle_integral * to_lamp_m * to_lamp_m)
    return by_walk / (by_walk + by_connection)


@kernel
def bin_of(view, bin_edges_px, x, y, z):
    """Returns the bin of the distance in the image from a pixel to a point; the last one is open, and behind."""
    # `view` (5, 3): camera axes in the world, position [m], pixel from the principal point and focal length [px]
    a, b, c = x - view[3, 0], y - view[3, 1], z - view[3, 2]
    depth = a * view[2, 0] + b * view[2, 1] + c * view[2, 2]
    last = bin_edges_px.shape[0] - 1
    if depth <= 0:
        return last
    u = view[4, 2] * (a * view[0, 0] + b * view[0, 1] + c * view[0, 2]) / depth - view[4, 0]
    v = view[4, 2] * (a * view[1, 0] + b * view[1, 1] + c * view[1, 2]) / depth - view[4, 1]
    away = np.sqrt(u * u + v * v)
    k = last
    while k > 0 and bin_edges_px[k] > away:
        k -= 1
    return k


@kernel
def flight(scene, point, x, y, z, rng):
    """Returns kind and distance [m] of the next vertex; ABOVE: the path leaves the water, NOWHERE: it meets nothing."""
    floor_m = cast_ray(scene.relief, point[0], point[1], point[2], x, y, z)
    surface_m = (scene.surface_m - point[2]) / z if z > 0 else np.inf
    step_m = -np.log(1 - rng.random()) / scene.scattering if scene.scattering > 0 else np.inf
    if step_m >= surface_m and surface_m <= floor_m:
        return ABOVE, surface_m
    if step_m == np.inf and floor_m == np.inf:
        return NOWHERE, np.inf
    return (IN_WATER if step_m < floor_m else ON_FLOOR), min(step_m, floor_m)


@kernel
def vertex(scene, kind, point, step_m, x, y, z):
    """Returns the point at a distance in a unit direction, lifted off the floor, and its `axis`."""
    px, py, pz = point[0] + step_m * x, point[1] + step_m * y, point[2] + step_m * z
    if kind != ON_FLOOR:
        return (px, py, pz), (x, y, z)
    nx, ny, nz = floor_normal(scene.relief, px, py)
    return (px + LIFT_M * nx, py + LIFT_M * ny, pz + LIFT_M * nz), (nx, ny, nz)


@kernel
def walk(scene, view, bin_edges_px, kind, point, axis, weight, rng, sums):
    """Adds the light of one random walk from `point`, whose response has the `axis`, to `sums`.

    `sums` (FIRST_BIN + 2 n,) [cd/m2]: DIRECT, LAMP_SCATTERED, VEIL_ONCE, VEIL_MORE; then n bins of blurred light that
    had reached the floor straight, and n bins of all other.
    """
    unscattered, before_floor, at_first_floor = kind == ON_FLOOR, kind == IN_WATER, False
    n_bins, at_bin, start = bin_edges_px.shape[0], 0, weight
    before, density, step_m = point, 0.0, 0.0
    for order in range(STEPS):
        first = order == 0
        shared = 0.0 if scene.plain or kind == ON_FLOOR else density  # density is 0 at the first vertex
        guided = 0.0 if scene.plain else (GUIDED_AT_FLOOR if kind == ON_FLOOR else GUIDED_IN_WATER)
        once = weight * sunlight(scene, kind, point, axis, guided, rng)
        once += weight * straight(scene, kind, point, axis, before, shared, step_m)
        more = 0.0
        if not scene.plain and scene.scattering > 0:
            more = weight * by_one_scattering(scene, kind, point, axis, guided, rng)
        if before_floor:
            to, to_more = VEIL_ONCE if first else VEIL_MORE, VEIL_MORE
        elif unscattered:
            to, to_more = DIRECT if first else LAMP_SCATTERED, LAMP_SCATTERED
        else:
            to, to_more = FIRST_BIN + at_bin + (0 if at_first_floor else n_bins), FIRST_BIN + at_bin + n_bins
            at_first_floor = False
        if to != DIRECT:  # `trace_pixel` computes the unscattered light of lamps and sun once, without sampling
            sums[to] += once
        sums[to_more] += more
        if scene.scattering <= 0 and scene.sky.shape[0] < 2:
            return
        x, y, z = next_direction(scene, kind, point, axis, guided, rng)
        own = response(scene, kind, axis, x, y, z)
        if own <= 0:
            return
        density = direction_density(scene, kind, point, axis, guided, own, x, y, z)
        weight *= own / density
        if weight < WEAK * start:
            survival = weight / (WEAK * start)
            if rng.random() >= survival:
                return
            weight = WEAK * start
        from_water = kind == IN_WATER
        kind, step_m = flight(scene, point, x, y, z, rng)
        if kind == ABOVE:
            above = light_above(scene, from_water, density, step_m, x, y, z)
            sums[to] += weight * np.exp(-scene.absorption * step_m) * above
        if kind > IN_WATER:
            return
        weight *= np.exp(-scene.absorption * step_m)
        before = point
        point, axis = vertex(scene, kind, point, step_m, x, y, z)
        if kind == ON_FLOOR:
            if scene.albedo <= 0:
                return
            if before_floor:
                before_floor, at_first_floor = False, True
                at_bin = bin_of(view, bin_edges_px, point[0], point[1], point[2])


@kernel
def trace_pixel(scene, view, bin_edges_px, n_walks, rng):
    """Returns the light of a pixel (FIRST_BIN + 2 n,) [cd/m2], as `sums` of `walk`: the mean of pairs of walks."""
    # One of a pair starts at the floor, one in the water; unscattered light on the floor point takes none.
    sums = np.zeros(FIRST_BIN + 2 * bin_edges_px.shape[0])
    centre = (view[3, 0], view[3, 1], view[3, 2])
    a, b, f = view[4, 0], view[4, 1], view[4, 2]
    length = np.sqrt(a * a + b * b + f * f)
    x = (a * view[0, 0] + b * view[1, 0] + f * view[2, 0]) / length
    y = (a * view[0, 1] + b * view[1, 1] + f * view[2, 1]) / length
    z = (a * view[0, 2] + b * view[1, 2] + f * view[2, 2]) / length
    ray = (x, y, z)
    floor_m = cast_ray(scene.relief, centre[0], centre[1], centre[2], x, y, z)
    end_m = min(floor_m, (scene.surface_m - centre[2]) / z if z > 0 else np.inf)
    seen = floor_m < np.inf and floor_m <= end_m and scene.albedo > 0
    share = 1 - np.exp(-scene.scattering * end_m) if scene.scattering > 0 else 0.0
    arrives, shown, normal = 0.0, centre, ray
    if seen:
        arrives = np.exp(-(scene.absorption + scene.scattering) * floor_m)
        shown, normal = vertex(scene, ON_FLOOR, centre, floor_m, x, y, z)
        direct = straight(scene, ON_FLOOR, shown, normal, shown, 0.0, 0.0)
        direct += sunlight(scene, ON_FLOOR, shown, normal, 0.0, rng)
        sums[DIRECT] = n_walks * arrives * direct
    for k in range(n_walks):
        if seen and (scene.scattering > 0 or scene.sky.shape[0] > 1):
            walk(scene, view, bin_edges_px, ON_FLOOR, shown, normal, arrives, rng, sums)
        if share > 0:
            at_m = -np.log(1 - share * (k + rng.random()) / n_walks) / scene.scattering
            weight = share * np.exp(-scene.absorption * at_m)
            point = (centre[0] + at_m * x, centre[1] + at_m * y, centre[2] + at_m * z)
            walk(scene, view, bin_edges_px, IN_WATER, point, ray, weight, rng, sums)
    return sums / n_walks


@kernel
def trace_plane(scene, point, normal, n_walks, rng):
    """Returns the illuminance (3,) of a plane: direct light of the sun, of the sky, and all other light [lx]."""
    out, sums, no_view, edges = np.zeros(3), np.zeros(FIRST_BIN + 2), np.zeros((5, 3)), np.zeros(1)
    sx, sy, sz = scene.to_sun[0], scene.to_sun[1], scene.to_sun[2]
    guided = 0.0 if scene.plain else GUIDED_AT_FLOOR
    facing = normal[0] * sx + normal[1] * sy + normal[2] * sz
    if scene.sun_lx > 0 and facing > 0 and cast_ray(scene.relief, point[0], point[1], point[2], sx, sy, sz) == np.inf:
        attenuation = scene.absorption + scene.scattering
        out[0] = n_walks * facing * scene.sun_lx * np.exp(-attenuation * (scene.surface_m - point[2]) / sz)
    for _ in range(n_walks):
        x, y, z = next_direction(scene, ON_FLOOR, point, normal, guided, rng)
        cosine = normal[0] * x + normal[1] * y + normal[2] * z
        if cosine <= 0:
            continue
        own = cosine / np.pi
        weight = cosine / direction_density(scene, IN_WATER, point, (0.0, 0.0, 1.0), guided, own, x, y, z)
        kind, step_m = flight(scene, point, x, y, z, rng)
        if kind == ABOVE:
            light = light_above(scene, False, 0.0, step_m, x, y, z)
            out[1] += weight * np.exp(-scene.absorption * step_m) * light
        if kind > IN_WATER or (kind == ON_FLOOR and scene.albedo <= 0):
            continue
        weight *= np.exp(-scene.absorption * step_m)
        next_point, axis = vertex(scene, kind, point, step_m, x, y, z)
        if kind == ON_FLOOR:
            first = straight(scene, ON_FLOOR, next_point, axis, next_point, 0.0, 0.0)
            first += sunlight(scene, ON_FLOOR, next_point, axis, 0.0, rng)
            sums[LAMP_SCATTERED] += weight * first
        walk(scene, no_view, edges, kind, next_point, axis, weight, rng, sums)
    out[2] = sums.sum()
    return out / n_walks
