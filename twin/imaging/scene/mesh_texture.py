"""Colours of textured meshes: trilinear samples of levels as coarse as the most stretched pixel (Williams 1983)."""

import numpy as np
from numpy.typing import NDArray

from twin.imaging.scene.mesh_raster import Projection, Target
from twin.kernels import kernel
from twin.terrains.objects.texture_pyramid import Textures

LEAST_COSINE = 0.1  #: smallest cosine of the angle between ray and normal; smaller ones count as this value


def paint_textures(target: Target, projection: Projection, textures: Textures, of_label: NDArray[np.int32]) -> None:
    """Draws textures into `target.albedo` after `draw_meshes`; none of the images of `target` is None."""
    # `of_label` (labels,) is the number of the texture of the mesh that `Target.label` names; -1: none
    _paint(*target, projection, *textures, of_label)


@kernel(error_model="numpy")
def _paint(depth, albedo, normal, label, uv, projection, texels, levels, of_label):
    focal, cx, cy, _, perspective = projection
    height, width = depth.shape
    coarsest = levels.shape[1] - 1
    for v in range(height):
        for u in range(width):
            texture = of_label[label[v, u]]
            if texture < 0:
                continue
            x, y = (u - cx) / focal, (v - cy) / focal
            pixel_m = 1 / focal
            cosine = abs(np.float64(normal[v, u, 2]))
            if perspective:
                pixel_m *= depth[v, u]
                along = normal[v, u, 0] * x + normal[v, u, 1] * y + normal[v, u, 2]
                cosine = abs(along) / np.sqrt(x * x + y * y + 1)
            pixel_m /= max(cosine, LEAST_COSINE)
            level = min(max(np.log2(pixel_m / uv[v, u, 2]), 0.0), np.float64(coarsest))
            fine = int(level)
            share = level - fine
            r, g, b = _sample(texels, levels[texture, fine], uv[v, u, 0], uv[v, u, 1])
            if share > 0:
                r2, g2, b2 = _sample(texels, levels[texture, fine + 1], uv[v, u, 0], uv[v, u, 1])
                r, g, b = r + share * (r2 - r), g + share * (g2 - g), b + share * (b2 - b)
            albedo[v, u, 0], albedo[v, u, 1], albedo[v, u, 2] = np.uint8(r + 0.5), np.uint8(g + 0.5), np.uint8(b + 0.5)


@kernel(error_model="numpy", inline="always")
def _sample(texels, level, across, down):
    """Returns red, green and blue of a level at texture coordinates, interpolated bilinearly; the texture repeats."""
    first, rows, cols = level
    col, row = (across - np.floor(across)) * cols - 0.5, (down - np.floor(down)) * rows - 0.5
    c0, r0 = int(np.floor(col)), int(np.floor(row))
    s, t = col - c0, row - r0
    c0, r0 = c0 % cols, r0 % rows
    c1, r1 = (c0 + 1) % cols, (r0 + 1) % rows
    nw, ne, sw, se = first + r0 * cols + c0, first + r0 * cols + c1, first + r1 * cols + c0, first + r1 * cols + c1
    a, b, c, d = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    red = a * texels[nw, 0] + b * texels[ne, 0] + c * texels[sw, 0] + d * texels[se, 0]
    green = a * texels[nw, 1] + b * texels[ne, 1] + c * texels[sw, 1] + d * texels[se, 1]
    blue = a * texels[nw, 2] + b * texels[ne, 2] + c * texels[sw, 2] + d * texels[se, 2]
    return red, green, blue
