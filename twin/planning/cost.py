"""Computing cost of a survey: time, memory and disk, estimated from its plan.

The coefficients are fitted to four rendered surveys of `reef` (area 1.2 m x 0.8 m, one track, 413 frames; images
of 320 x 240 and 640 x 480 px, 19 and 51 keyframes) on a 2-core x86-64 machine without GPU: 30, 39, 47 and 71 s of
processor time, 485, 502, 585 and 657 MB of memory, 11, 22, 28 and 65 MB of disk. The machine was fully loaded, so
the time coefficients are multiplied by 0.6; they then reproduce the 46 s of processor time of `reef` on an idle
machine. The coefficients of the surrogate are fitted to `horseshoe` with 50 and 362 keyframes (16 and 22 s on the
loaded machine). Times on other machines can differ by a factor of two.
"""

from typing import NamedTuple

from twin.world.mission import Mission


class ComputingCost(NamedTuple):
    wall_s: float  #: processor time on an idle 2-core machine [s]
    memory_mb: float  #: peak memory [MB]
    disk_mb: float  #: disk space of the run folder [MB]


class _Coefficients(NamedTuple):
    """Coefficients of a cost: fixed, per frame, per frame and megapixel, per keyframe, per keyframe and megapixel."""

    start: float
    frame: float = 0.0
    frame_mpx: float = 0.0
    keyframe: float = 0.0
    keyframe_mpx: float = 0.0

    def total(self, n_frames: int, n_keyframes: int, megapixels: float) -> float:
        frame = self.frame + self.frame_mpx * megapixels
        return self.start + n_frames * frame + n_keyframes * (self.keyframe + self.keyframe_mpx * megapixels)


_RENDERED_S = _Coefficients(start=11.0, frame=0.0066, frame_mpx=0.048, keyframe=0.066, keyframe_mpx=1.25)
_SURROGATE_S = _Coefficients(start=9.0, frame=1e-4, keyframe=0.01)
_RENDERED_DISK_MB = _Coefficients(start=5.0, keyframe=0.07, keyframe_mpx=3.6)
_SURROGATE_DISK_MB = _Coefficients(start=15.0, keyframe=0.02)
_RENDERED_MB = _Coefficients(start=415.0, keyframe_mpx=7.0)
_IMAGES_MB_PER_MPX = 300.0
_SURROGATE_MB = 380.0
#: Memory of the floor [MB] of a rendered survey, per node of the height grid and per texel (see `terrains.terrain`).
_NODE_MB, _TEXEL_MB = 400e-6, 9e-6
_WALL_CELL_MB, _WALL_TEXEL_MB = 36e-6, 14e-6  #: memory of walls [MB], per steep cell and per texel of their texture
_FACE_MB, _MESH_TEXEL_MB = 80e-6, 4e-6  #: memory of a mesh floor [MB], per triangle and per texel of its textures


def computing_cost(mission: Mission, n_keyframes: int) -> ComputingCost:
    megapixels = mission.rig.width_px * mission.rig.height_px / 1e6
    size = mission.n_frames, n_keyframes, megapixels
    if mission.scenario.imaging.fidelity == "surrogate":
        return ComputingCost(_SURROGATE_S.total(*size), _SURROGATE_MB, _SURROGATE_DISK_MB.total(*size))
    window_tracks = mission.scenario.estimator_settings().window_tracks
    window = round(n_keyframes * min(1.0, (window_tracks + 1) / len(mission.tracks)))
    memory_mb = _RENDERED_MB.total(mission.n_frames, window, megapixels) + _IMAGES_MB_PER_MPX * megapixels
    return ComputingCost(_RENDERED_S.total(*size), memory_mb + _floor_mb(mission), _RENDERED_DISK_MB.total(*size))


def _floor_mb(mission: Mission) -> float:
    terrain, walls = mission.terrain, mission.terrain.walls
    floor_mb = _NODE_MB * terrain.height_m.size + _TEXEL_MB * (terrain.texture.size / 3)
    if mission.mesh_floor is not None:
        tiles, textures = mission.mesh_floor.tiles
        n_faces = sum(len(tile.placed.model.levels[0].mesh.faces) for tile in tiles)
        floor_mb += _FACE_MB * n_faces + _MESH_TEXEL_MB * len(textures.texels) * 3 / 4
    if walls is not None:
        floor_mb += _WALL_CELL_MB * len(walls.weights) + _WALL_TEXEL_MB * walls.texture.size / 3
    return floor_mb
