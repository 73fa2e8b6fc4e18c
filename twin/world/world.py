"""Simulated world of a survey: executes commands, returns frames and records the ground truth."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from twin.controllers.camera_surface import surface_above_floor
from twin.controllers.thruster_monitor import ThrusterMonitor
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.ortho_tiles import at_centres
from twin.core.records import Exposure, Frame, Image, MapGrid, Readings, StereoRig, Trajectory, Truth
from twin.core.series import GrowingArray
from twin.core.timing import StageTimer
from twin.errors import TwinError
from twin.simulate.autopilot import commanded_thrusts_n, full_thrust_n
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.echo_sounders import Altimeter, BottomLock
from twin.simulate.faults import Faults
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.reading_times import Delays
from twin.simulate.sensors import NavigationSensors
from twin.terrains import Terrain
from twin.world.mission import Detail, FrameSequence, Mission, Step
from twin.world.observed_cells import seen_over
from twin.world.pilot import PilotOfEstimates
from twin.world.planning import floor_of as field_of
from twin.world.planning import smoothed_over
from twin.world.top_surface import TopSurface, true_albedo, true_heights, without_objects

if TYPE_CHECKING:
    from twin.simulate.mujoco_vehicle import MujocoVehicle

    AnyVehicle = MujocoVehicle | CompiledVehicle | KinematicVehicle

#: Random streams in the order of their seeds; a new one at the end leaves the numbers of the others unchanged.
_STREAMS = (
    "left_camera", "right_camera", "navigation", "dvl", "usbl", "beacons", "snow", "surrogate", "imu", "sea", "faults",
    "altimeter",
)  # fmt: skip

#: Simulates frames from index k, at most up to the next keyframe; returns the index of the first one not simulated.
FastForward = Callable[[FrameSequence, int], int]

_ANY_SLOPE = (1e6, 1e6)


class CameraImages(NamedTuple):
    """Images of the stereo cameras at one time."""

    left: Image
    right: Image | None  #: None between keyframes
    depth_m: Callable[[], NDArray[np.float32]]  #: returns the true depth (H, W) of the left image [m]
    exposure: Exposure | None = None  #: as `Frame.exposure`


class World(ABC):
    """Simulated world of a mission, a context manager.

    Attributes:
        warnings: limitations, for log and report.
        measured: readings taken at the last frame, some of which arrive later.
    """

    warnings: tuple[str, ...] = ()

    def __init__(self, mission: Mission, stopwatch: StageTimer, vehicle: "AnyVehicle", sensors: NavigationSensors):
        self.mission, self.stopwatch, self.vehicle, self.sensors = mission, stopwatch, vehicle, sensors
        scenario = mission.scenario
        duration_s = 2 * mission.n_frames / mission.rig.frame_rate_hz  # also of a survey that is slowed
        rng, floor_m = streams(scenario.seed)["faults"], scenario.plan.altitude_m
        self.faults = Faults(scenario.faults, duration_s, rng, mission.rig, floor_m)
        #: what the vehicle knows of its thrusters; without faults, all give the thrusts of their commands
        self.thruster_monitor = ThrusterMonitor(full_thrust_n(scenario.vehicle), mission.rig.frame_rate_hz)
        self._altimeter = self._bottom_lock = None
        navigation = scenario.navigation
        if scenario.control.height == "altimeter":
            floor = field_of(self.true_floor())
            self._altimeter = Altimeter(navigation, floor, streams(scenario.seed)["altimeter"])
        if navigation.dvl_range_m is not None:
            floor = field_of(self.true_floor())
            self._bottom_lock = BottomLock(navigation.dvl_range_m, navigation.dvl_beam_deg, floor)
        self._delays, self.measured = Delays(navigation.delays_s), Readings()
        self._true_poses = GrowingArray(4, 4)
        self._sequences: list[FrameSequence] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return  # a world holds no resources

    @property
    def made_anew(self) -> tuple[object, ...]:
        """Returns objects that follow from the mission alone, in one order: a checkpoint of the world lacks them."""
        floors = (one and one.floor for one in (self._altimeter, self._bottom_lock))
        return (self.mission, *vars(self.mission).values(), *floors)

    @abstractmethod
    def capture(self, step: Step) -> CameraImages:
        """Returns the images of the cameras at the current pose."""

    def extra_pair(self) -> tuple[Image, Image]:
        """Returns a left and a right image (H, W, 3) at the current pose, without an effect on later frames."""
        raise TwinError("imaging.fidelity", "the surrogate has no images", '"rendered"')

    def right_image(self) -> Image | None:
        """Returns the right image (H, W, 3) of the last frame captured without one, or None; affects no other image."""
        return None

    @abstractmethod
    def seen(self) -> NDArray[np.bool_]:
        """Returns for each cell of the map (rows, cols) whether both cameras observed it in at least one keyframe."""

    @property
    def world_from_camera(self) -> Array:
        return left_camera(self.vehicle, self.mission.rig)

    @property
    def thrust_n(self) -> Array:
        """Returns the thrust (n,) of each thruster now [N]; empty for a kinematic vehicle."""
        if isinstance(self.vehicle, KinematicVehicle):
            return np.zeros(0)
        return self.vehicle.thrusters.c @ self.vehicle.thrusters.lag_state

    def start_sequence(self, sequence: FrameSequence) -> None:
        """Starts the next planned frames of a track, after all frames of the last sequence (or `end_sequence`)."""
        kept = sequence.reference._replace(velocity=np.zeros((0, 3)), acceleration=np.zeros((0, 3)))
        self._sequences.append(replace(sequence, reference=kept))  # what the truth needs

    def end_sequence(self, n: int) -> None:
        self._sequences[-1] = self._sequences[-1].first(n)

    def observe(self, step: Step) -> Frame:
        """Returns the frame at the current pose and records its ground truth."""
        index, time_s = len(self), len(self) / self.mission.rig.frame_rate_hz
        self.faults.at(time_s, self.world_from_camera[:3, 3])
        images = self.capture(step)
        self.record(self.world_from_camera)
        left, right = self.faults.images(images.left, images.right)
        assert left is not None
        depth_m = images.depth_m if step.keyframe else None
        body = self.vehicle.world_from_body
        readings = self.sensors.read(time_s, body, self.vehicle.twist_body, depth_m)
        if readings.dvl_mps is not None and self._bottom_lock is not None and not self._bottom_lock.holds(body):
            readings = replace(readings, dvl_mps=None)
        if self._altimeter is not None:
            readings = replace(readings, altitude_m=self._altimeter.read(self.world_from_camera))
        self.measured = self.faults.readings(readings)
        readings = self._delays.deliver(time_s, self.measured)
        return Frame(index, time_s, left, right, readings, step.keyframe, images.exposure)

    def act(self, command: Array) -> None:
        scenario, interval_s = self.mission.scenario, 1 / self.mission.rig.frame_rate_hz
        with self.stopwatch("physics"):
            if not self.faults.exist or isinstance(self.vehicle, KinematicVehicle):
                self.vehicle.step(command, interval_s)
                return
            thrusters, pose = self.vehicle.thrusters, self.vehicle.world_from_body
            n = len(thrusters.factors)  # commands of fins follow those of the thrusters
            arriving, factors = self.faults.thrusts(command)
            thrusters.factors[:] = factors[:n]
            tether = self.vehicle.tether
            self.faults.catch_tether(tether, geometry.transform(pose, tether.attachment_m))
            self.faults.blow(self.vehicle.sea.single_gusts, pose[:3, 1])
            self.vehicle.step(arriving, interval_s)
            if scenario.control.thruster_feedback == "speed":
                commanded_n = commanded_thrusts_n(scenario.vehicle, command[:n])
                self.thruster_monitor.add(len(self) * interval_s, commanded_n, thrusters.steady_n)

    def __len__(self) -> int:
        return len(self._true_poses)

    def record(self, poses: Array) -> None:
        """Records the true pose (4, 4) of one frame, or the poses (n, 4, 4) of several frames."""
        self._true_poses.append(poses)

    def fast_forward(self, navigator: Any, pilot: PilotOfEstimates) -> FastForward:
        """Returns a function that simulates frames between keyframes quickly; here, one that simulates none."""
        return lambda sequence, k: k

    def truth(self) -> Truth:
        n, surface, cells, terrain = len(self), self.true_surface(), self.mission.grid, self.mission.terrain
        unknown = at_centres(terrain.in_hole, cells)

        def albedo(grid: MapGrid) -> NDArray[np.float32]:
            colours = without_objects(true_albedo(terrain, grid), grid, surface.objects, cells)
            colours[at_centres(terrain.in_hole, grid)] = np.nan
            return colours

        parts = self._sequences
        lengths = np.array([len(part) for part in parts], np.int64)
        return Truth(
            trajectory=Trajectory(np.arange(n) / self.mission.rig.frame_rate_hz, self._true_poses.array),
            reference=np.concatenate([np.empty((0, 3)), *(part.reference.position for part in parts)])[:n],
            holding=np.repeat(np.array([part.holding for part in parts], np.bool_), lengths)[:n],
            track=np.repeat(np.array([part.track for part in parts], np.int64), lengths)[:n],
            height_m=np.where(unknown, np.float32(np.nan), surface.height_m), seen=self.seen() & ~unknown,
            asked=at_centres(self.mission.asked, cells),
            reference_yaw=np.concatenate([np.empty(0), *(np.asarray(part.reference.yaw) for part in parts)])[:n],
            albedo=albedo, in_area=self.mission.asked, objects=surface.objects, overhung=surface.overhung,
            heights_to_follow=self._heights_to_follow() if self.mission.plan.follows_floor else None,
        )  # fmt: skip

    def true_floor(self) -> Terrain:
        """Returns the floor as a height grid, with the objects that this world simulates."""
        return self.mission.terrain

    def _heights_to_follow(self) -> Callable[[Array, Array], tuple[Array, Array]]:
        mission, floor = self.mission, self.true_floor()
        sides_m, request = smoothed_over(mission.scenario, mission.plan.request), mission.plan.request
        surface = surface_above_floor(
            floor.height_near, mission.plan.area, floor.spacing_m, request.altitude_m, sides_m, _ANY_SLOPE
        )
        return lambda x, y: (surface.height_at(x, y), floor.height_at(x, y))

    def true_surface(self) -> TopSurface:
        return self.surface_on(self.mission.grid)

    def surface_on(self, grid: MapGrid) -> TopSurface:
        """Returns the true surface as seen from above at the cells of a grid."""
        return TopSurface(true_heights(grid, self.mission.terrain.height_at))

    def detail_truth(self, detail: Detail, truth: Truth, rows: NDArray[np.int64]) -> Truth:
        """Returns the truth of a survey at the cells of the map of a task, from keyframes at rows of the trajectory."""
        cells, surface = np.meshgrid(*detail.grid.centres()), self.surface_on(detail.grid)
        unknown, poses = self.mission.terrain.in_hole(*cells), self._true_poses.array[rows]
        return replace(
            truth, height_m=np.where(unknown, np.float32(np.nan), surface.height_m),
            seen=seen_over(detail.grid, self.mission.rig, field_of(self.true_floor()), poses) & ~unknown,
            asked=detail.area.contains(*cells) & ~unknown, objects=surface.objects, overhung=surface.overhung,
        )  # fmt: skip


def left_camera(vehicle: "AnyVehicle", rig: StereoRig) -> Array:
    """Returns the true world_from_camera (4, 4) of the left camera of a vehicle."""
    return geometry.compose(vehicle.world_from_body, rig.body_from_camera)


def streams(seed: int) -> dict[str, np.random.Generator]:
    seeds = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
