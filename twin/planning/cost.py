"""Computing cost of a survey: time, memory and disk, estimated from its plan.

The coefficients of rendered surveys are the times of the stages per frame and per keyframe that `twin bench` measures,
at 320 x 240 and 640 x 480 pixels; the start is what a whole run of `reef` takes beyond these (imports, opening of the
world, report, recording). Memory is the peak of the whole process: of the report, or of the flight with a large
texture, which is freed before the report. Measured on a 2-core x86-64 machine without GPU, where compiled code is kept
on disk; other machines may differ by a factor of two.
"""

from typing import NamedTuple

from twin.world.mission import Mission


class ComputingCost(NamedTuple):
    wall_s: float  #: processor time, of all threads [s]
    memory_mb: float  #: peak memory [MB]
    disk_mb: float  #: disk space of the run folder [MB]
    flight_disk_mb: float  #: disk space until the maps are made, with the disparities of keyframes [MB]


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


_RENDERED_S = _Coefficients(start=9.7, frame=0.0087, frame_mpx=0.221, keyframe=0.07, keyframe_mpx=3.0)
_OBJECTS_S = _Coefficients(start=4.0, frame=0.022)  # in addition, with objects in the images
_SURROGATE_S = _Coefficients(start=10.6, keyframe=0.038)
_RENDERED_DISK_MB = _Coefficients(start=6.0, keyframe=0.033)  # without images
_PAIR_MB_PER_MPX, _DISPARITY_MB_PER_MPX = 4.2, 4.0  # of the images of a frame; of a keyframe, in 16-bit numbers
_SURROGATE_DISK_MB = _Coefficients(start=4.8, keyframe=0.056)
_RENDERED_MB = _Coefficients(start=555.0, frame=0.0045, keyframe=0.0125)
_IMAGES_MB_PER_MPX = 500.0
_SURROGATE_MB = _Coefficients(start=507.0, frame=0.006)
_REPORT_MB = 180.0  #: part of `start` of report and recording
#: Memory of the floor [MB] of a rendered survey, per node of the height grid and per texel (see `terrains.terrain`).
_NODE_MB, _TEXEL_MB = 40e-6, 4e-6
_WALL_CELL_MB, _WALL_TEXEL_MB = 36e-6, 14e-6  #: memory of walls [MB], per steep cell and per texel of their texture
_FACE_MB, _MESH_TEXEL_MB = 80e-6, 4e-6  #: memory of a mesh floor [MB], per triangle and per texel of its textures


def computing_cost(mission: Mission, n_keyframes: int) -> ComputingCost:
    megapixels = mission.rig.width_px * mission.rig.height_px / 1e6
    size = mission.n_frames, n_keyframes, megapixels
    if mission.scenario.imaging.fidelity == "surrogate":
        disk_mb = _SURROGATE_DISK_MB.total(*size)
        return ComputingCost(_SURROGATE_S.total(*size), _SURROGATE_MB.total(*size), disk_mb, disk_mb)
    memory_mb = _RENDERED_MB.total(*size) + _floor_mb(mission)
    time_s = _RENDERED_S.total(*size) + (_OBJECTS_S.total(*size) if mission.objects else 0.0)
    n_kept = {"none": 0, "keyframes": n_keyframes, "all": mission.n_frames + n_keyframes}[mission.scenario.record]
    disk_mb = _RENDERED_DISK_MB.total(*size) + n_kept * megapixels * _PAIR_MB_PER_MPX
    until_end_mb = n_keyframes * megapixels * (_DISPARITY_MB_PER_MPX + _PAIR_MB_PER_MPX * (n_kept == 0))
    return ComputingCost(time_s, memory_mb + _IMAGES_MB_PER_MPX * megapixels, disk_mb, disk_mb + until_end_mb)


def _floor_mb(mission: Mission) -> float:
    terrain, walls, (rows, cols, _) = mission.terrain, mission.terrain.walls, mission.terrain.colours.shape
    floor_mb = _NODE_MB * terrain.height_m.size + max(0.0, _TEXEL_MB * (rows * cols) - _REPORT_MB)
    if mission.mesh_floor is not None:
        tiles, textures = mission.mesh_floor.tiles
        n_faces = sum(len(tile.placed.model.levels[0].mesh.faces) for tile in tiles)
        floor_mb += _FACE_MB * n_faces + _MESH_TEXEL_MB * len(textures.texels) * 3 / 4
    if walls is not None:
        rows, cols, _ = walls.texture.shape
        floor_mb += _WALL_CELL_MB * len(walls.weights) + _WALL_TEXEL_MB * (rows * cols)
    return floor_mb
