"""Currents from NetCDF files of the CF convention: the same flow as from CSV, and files that are refused."""

import numpy as np
import pytest

from twin.errors import TwinError
from twin.scenario.model import CurrentConfig, Scenario, SunConfig
from twin.simulate.sea import flow_at, make_sea
from twin.world.scenario_checks import contradictions

xarray = pytest.importorskip("xarray")
pytest.importorskip("netCDF4")

LONGITUDES, LATITUDES = np.array([-3.5, -3.25, -3.0]), np.array([54.0, 54.25])
DEPTHS, HOURS = np.array([2.0, 8.0, 11.5, 14.0]), np.array([0, 1, 3])
START = np.datetime64("2026-05-01T06:00:00", "ns")
UNUSED = "file_start", "file_place_deg"
EAST, NORTH, UP = (f"{way}_sea_water_velocity" for way in ("eastward", "northward", "upward"))


def model_of(seed=0, places=True):
    """Returns a dataset (time, depth, latitude, longitude) of random velocities, or one of a single place."""
    rng, dims = np.random.default_rng(seed), ("time", "lev", "lat", "lon")[: 4 if places else 2]
    shape = (3, 4, 2, 3)[: len(dims)]
    parts = {
        name: (dims, rng.uniform(-0.3, 0.3, shape), {"standard_name": standard, "units": "m s-1"})
        for name, standard in (("u", EAST), ("v", NORTH), ("w", UP))
    }
    coordinates = {
        "time": ("time", START + HOURS * np.timedelta64(1, "h"), {"standard_name": "time"}),
        "lev": ("lev", DEPTHS, {"standard_name": "depth", "units": "m", "positive": "down"}),
    }
    if places:
        coordinates["lat"] = ("lat", LATITUDES, {"standard_name": "latitude", "units": "degrees_north"})
        coordinates["lon"] = ("lon", LONGITUDES, {"standard_name": "longitude", "units": "degrees_east"})
    return xarray.Dataset(parts, coordinates)


def written(data, folder, **options):
    file = folder / "current.nc"
    data.to_netcdf(file, **{"engine": "netcdf4"} | options)
    return str(file)


def sea_of(file, depth_m=12.5, **keys):
    return make_sea(Scenario(current=CurrentConfig(file=file, **keys), sun=SunConfig(depth_m=depth_m)))


def csv_of(data, folder, depth_m=12.5, start=START):
    rows = ["time_s,height_m,east_mps,north_mps,up_mps"]
    for t, instant in enumerate(data.time.values):
        for k, depth in enumerate(data.lev.values):
            here = data.isel(time=t, lev=k)
            values = (instant - start) / np.timedelta64(1, "s"), depth_m - depth, here.u, here.v, here.w
            rows.append(",".join(repr(float(value)) for value in values))
    file = folder / "current.csv"
    file.write_text("\n".join(rows))
    return str(file)


def assert_same(sea, expected):
    for found, wanted in zip(sea[:3], expected[:3], strict=True):
        assert found.tobytes() == wanted.tobytes() and found.shape == wanted.shape
    for time_s, height_m in ((0.0, 0.2), (4321.0, 2.34), (1e5, 9.0)):
        at = np.array([1.0, 2.0, height_m])
        assert flow_at(sea, time_s, at).tobytes() == flow_at(expected, time_s, at).tobytes()


@pytest.mark.parametrize("format", ["NETCDF4", "NETCDF3_64BIT", "NETCDF3_CLASSIC", "NETCDF4_CLASSIC"])
def test_the_flow_of_a_netcdf_file_is_that_of_the_same_numbers_as_csv(tmp_path, format):
    """NetCDF 4 and 3, at one place, at depths down to below the reference plane; the same bytes."""
    data = model_of(places=False)
    sea = sea_of(written(data, tmp_path, format=format))
    assert_same(sea, sea_of(csv_of(data, tmp_path)))
    assert sea.heights_m[0] == -1.5 and sea.times_s[-1] == 3 * 3600
    half = sea.mean_mps[0, 2]
    np.testing.assert_array_equal(half, [data.u[0, 1], data.v[0, 1], data.w[0, 1]])  # 8 m deep: 4.5 m above z = 0


def test_the_nearest_of_several_places_is_taken_at_the_stated_start(tmp_path):
    data = model_of()
    file = written(data, tmp_path)
    sea = sea_of(file, file_place_deg=(-3.2, 54.2), file_start="2026-05-01T05:30")
    here = data.isel(lat=1, lon=1)
    assert_same(sea, sea_of(csv_of(here, tmp_path, start=START - np.timedelta64(30, "m"))))
    assert_same(sea_of(file, file_place_deg=(356.8, 54.2), file_start="2026-05-01T05:30"), sea)


def test_the_nearest_place_of_a_curvilinear_grid_is_the_nearest_on_the_sphere(tmp_path):
    """Against the great-circle distances of all places, at 70 deg north, where a degree to the east is a third."""
    rng = np.random.default_rng(2)
    lat, lon = (
        70 + 0.1 * np.arange(2)[:, None] + np.zeros((2, 3)),
        10 + 0.25 * np.arange(3) + 0.1 * rng.uniform(size=(2, 3)),
    )
    data = model_of().drop_vars(["lat", "lon"])
    for name, values, standard, units in (
        ("la", lat, "latitude", "degrees_north"),
        ("lo", lon, "longitude", "degrees_east"),
    ):
        data[name] = (("lat", "lon"), values, {"standard_name": standard, "units": units})
    file = written(data, tmp_path)
    for at in ((10.31, 70.03), (10.2, 70.06), (10.44, 70.049)):
        a, b, c, d = (np.radians(v) for v in (*at, lon, lat))
        angle = np.arccos(np.sin(b) * np.sin(d) + np.cos(b) * np.cos(d) * np.cos(c - a))
        k, n = np.unravel_index(angle.argmin(), angle.shape)
        expected = sea_of(csv_of(data.isel(lat=int(k), lon=int(n)), tmp_path))
        assert_same(sea_of(file, file_place_deg=at), expected)


@pytest.mark.parametrize(("name", "positive", "values"), [
    ("depth", "up", -DEPTHS), ("depth", None, DEPTHS), ("height_above_sea_floor", None, 12.5 + 3 - DEPTHS),
])  # fmt: skip
def test_levels_have_the_direction_and_reference_that_the_file_states(tmp_path, name, positive, values):
    data = model_of(places=False)
    expected = sea_of(csv_of(data, tmp_path))
    attributes = {"standard_name": name, "units": "m"} | ({"positive": positive} if positive else {})
    data["lev"] = ("lev", values, attributes)
    sea = sea_of(written(data, tmp_path), depth_m=12.5)
    shift = 3.0 if name == "height_above_sea_floor" else 0.0
    np.testing.assert_array_equal(sea.heights_m, expected.heights_m + shift)
    assert sea.mean_mps.tobytes() == expected.mean_mps.tobytes()


def test_packed_values_are_unpacked_and_levels_below_the_floor_left_out(tmp_path):
    data = model_of(places=False)
    for name in "uvw":
        data[name] = np.round(data[name], 3)
    data["u"][:, 3] = np.nan
    data["v"][:, 2] = 30.0  # a fill value that is not declared
    packing = {"dtype": "int16", "scale_factor": 0.001, "_FillValue": -32768}
    sea = sea_of(written(data, tmp_path, encoding={name: packing for name in "uvw"}))
    expected = sea_of(csv_of(data.isel(lev=slice(0, 2)), tmp_path))
    np.testing.assert_array_equal(sea.heights_m, expected.heights_m)
    np.testing.assert_allclose(sea.mean_mps, expected.mean_mps, atol=1e-15)


def with_attributes(variable, **attributes):
    def change(data):
        data[variable].attrs.update(attributes)
        return data

    return change


def with_value(variable, value, *at):
    def change(data):
        data[variable].values[at] = value
        return data

    return change


def repeated(data):
    return xarray.concat([data, data.isel(time=[0])], "time", data_vars="all")


BAD = [
    (with_attributes("u", units="cm s-1"), {}, "units|in .'cm s-1'.*'m s-1'"),
    (with_attributes("lev", units="km"), {}, "depth of 1 variables, in ..km"),
    (with_attributes("lev", positive="sideways"), {}, "lev, positive sideways, is outside"),
    (with_attributes("lev", positive="up"), {}, "lev, positive up, is outside the water"),
    (with_attributes("lev", standard_name="ocean_sigma_coordinate"), {}, "has 0 vertical coordinates"),
    (with_attributes("v", standard_name="sea_water_y_velocity"), {}, "not both eastward.* and northward"),
    (with_attributes("v", standard_name=EAST), {}, "eastward_sea_water_velocity of 2 variables"),
    (with_value("u", np.nan, 1, 2), {}, "has 11 velocities for 3 times and 4 heights"),
    (with_value("u", np.nan, slice(None), slice(1, 4)), {}, "less than two of its levels"),
    (with_value("u", np.nan), {}, "less than two of its times"),
    (repeated, {}, "has 16 velocities for 3 times"),
    (lambda data: data.assign(v=data.v.isel(lev=0)), {}, r"v has \{'time': 3\}, the levels \{'lev': 4\}"),
    (lambda data: data.assign(lon=("time", HOURS, {"standard_name": "longitude", "units": "degrees_east"})), {},
     "its place changes with time"),
    (lambda data: data, {"file_place_deg": (1.0, 2.0)}, "file_place_deg: .*has no longitude"),
    (lambda data: data, {"depth_m": 0.0}, "waves.depth_m: missing"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "keys", "problem"), BAD)
def test_a_file_of_another_form_is_refused_in_one_line(tmp_path, change, keys, problem):
    file = written(change(model_of(places=False)), tmp_path)
    with pytest.raises(TwinError, match=problem) as caught:
        sea_of(file, **keys)
    assert "\n" not in str(caught.value)


def test_a_table_of_too_many_values_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("twin.simulate.current_file._MOST_VALUES", 11)
    with pytest.raises(TwinError, match="u has .*'time': 3, 'lev': 4"):
        sea_of(written(model_of(places=False), tmp_path))


def test_keys_of_netcdf_without_such_a_file_are_errors():
    keys = CurrentConfig(velocity_mps=(0.1, 0, 0), file_start="2026-05-01T06:00", file_place_deg=(1.0, 2.0))
    found = [str(error) for error in contradictions(Scenario(current=keys))]
    assert found == [f"current.{key}: is unused: current.file is not NetCDF (allowed: a file *.nc)" for key in UNUSED]
    assert not list(
        contradictions(Scenario(current=keys.model_copy(update={"velocity_mps": (0, 0, 0), "file": "x.nc"})))
    )


@pytest.mark.parametrize(("keys", "problem"), [
    ({}, "current.file: .*'lat': 2, 'lon': 3.*allowed: .*current.file_place_deg"),
    ({"file_place_deg": (2.0, 54.1)}, "current.file_place_deg: .*2.0, 54.1.: outside"),
])  # fmt: skip
def test_of_several_places_one_within_them_has_to_be_stated(tmp_path, keys, problem):
    file = written(model_of(), tmp_path)
    with pytest.raises(TwinError, match=problem):
        sea_of(file, **keys)


def test_files_that_are_not_netcdf_and_addresses_are_refused(tmp_path):
    whole = written(model_of(), tmp_path)
    content = open(whole, "rb").read()
    for text, problem in (
        (b"time_s,height_m", "cannot be read"),
        (content[:3000], "cannot be read"),
        (b"", "cannot be"),
    ):
        (tmp_path / "bad.nc").write_bytes(text)
        with pytest.raises(TwinError, match=f"current.file: 'bad.nc' {problem}"):
            sea_of(str(tmp_path / "bad.nc"))
    for file in ("https://example.org/x.nc", str(tmp_path / "none.nc")):
        with pytest.raises(TwinError, match="no such file"):
            sea_of(file)
    (tmp_path / "folder.nc").mkdir()
    with pytest.raises(TwinError, match="not a regular file"):
        sea_of(str(tmp_path / "folder.nc"))
