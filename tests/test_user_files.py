"""Files of strangers: only named formats are read, alone and within limits; a damaged file gives one TwinError."""

import functools
import http.server
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.shutil
import trimesh
from rasterio.transform import from_origin

from twin import terrains
from twin.core.user_files import path_problem, read_bytes, read_json, read_text
from twin.datasets.text_files import read_yaml
from twin.errors import TwinError
from twin.report.run_comparison import load_runs
from twin.report.run_folder import read_raster
from twin.scenario.file import load_scenario
from twin.terrains.objects.mesh_file import read_mesh
from twin.world.asked_area import read_area

ROOT = Path(__file__).parent.parent
PLACED = from_origin(500000.0, 8000000.0, 0.5, 0.5)
HEIGHTS = np.linspace(-8, -7, 35 * 40).reshape(35, 40)


def write_tif(file, values: Any = HEIGHTS, transform: Any = PLACED, tags=None, **profile):
    bands: Any = np.atleast_3d(values)
    layout = {"driver": "GTiff", "height": bands.shape[0], "width": bands.shape[1], "count": bands.shape[2]}
    with rasterio.open(file, "w", **layout, dtype=bands.dtype, transform=transform, **profile) as target:
        target.write(np.moveaxis(bands, 2, 0))
        target.update_tags(**(tags or {}))
    return file


def load(file, **texture):
    return terrains.load(file, terrains.TextureSource(0.5, **texture), 0.5, 1.0, 0, "up")


@pytest.fixture
def server():
    """Yields the address of a server, and the list of requests that it got."""
    requests = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):  # noqa: N802 (name of the base class)
            requests.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815 (name of the base class)

        def log_message(self, format, *args):  # noqa: A002 (name of the base class)
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as opened:
        threading.Thread(target=opened.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{opened.server_port}", requests
        opened.shutdown()


def vrt(source):
    return (
        '<VRTDataset rasterXSize="40" rasterYSize="35"><GeoTransform>0,0.5,0,0,0,-0.5</GeoTransform>'
        f'<VRTRasterBand dataType="Float64" band="1"><SimpleSource><SourceFilename>{source}</SourceFilename>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )


def wms(address):
    return (
        f'<GDAL_WMS><Service name="TMS"><ServerUrl>{address}/${{z}}</ServerUrl></Service><DataWindow>'
        "<UpperLeftX>0</UpperLeftX><UpperLeftY>0</UpperLeftY><LowerRightX>20</LowerRightX><LowerRightY>-20</LowerRightY>"
        "<SizeX>40</SizeX><SizeY>40</SizeY></DataWindow><BandsCount>1</BandsCount><DataType>Float32</DataType></GDAL_WMS>"
    )


def test_descriptions_that_name_other_files_or_servers_are_refused_without_a_request(server, tmp_path):
    address, requests = server
    other = write_tif(tmp_path / "other.tif")
    floor = write_tif(tmp_path / "floor.tif")
    for number, text in enumerate((vrt(other), vrt(f"/vsicurl/{address}/x.tif"), wms(address))):
        (tmp_path / f"{number}.tif").write_text(text)
        named = tmp_path / f"{number}.tif"
        uses = ({"file": named}, {"file": floor, "photo_file": named}, {"file": floor, "orthophoto_file": named})
        for use in uses:
            with pytest.raises(TwinError, match="is not a file of the format"):
                load(**use)
        with pytest.raises(TwinError, match="is not a file of the format"):
            read_raster(named)
    assert not requests


def test_overviews_and_masks_outside_a_file_are_never_opened(server, tmp_path):
    address, requests = server
    floor = write_tif(tmp_path / "floor.tif")
    colour = write_tif(tmp_path / "colour.tif", np.full((350, 400, 3), 80, np.uint8), from_origin(5e5, 8e6, 0.05, 0.05))
    for suffix in (".ovr", ".msk"):
        Path(f"{colour}{suffix}").write_text(vrt(f"/vsicurl/{address}/x.tif"))
    assert load(floor, orthophoto_file=colour).orthophoto_share == 1
    with rasterio.open(colour, "r+") as target:
        target.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{address}/x.tif")
    requests.clear()  # of the line before, which opens the file with GDAL's defaults
    with pytest.raises(TwinError, match="names another file, of overviews"):
        load(floor, orthophoto_file=colour)
    assert not requests


@pytest.mark.parametrize(
    ("name", "text"),
    [("dem.tfw", "0.5\n0\n0\n-0.5\n0\n0\n"), ("dem.tif.aux.xml", "<PAMDataset><SRS>x</SRS></PAMDataset>")],
)
def test_coordinates_in_a_file_beside_the_dem_are_refused_not_lost(tmp_path, name, text):
    file = write_tif(tmp_path / "dem.tif", transform=from_origin(0, 0, 1, 1) if name != "dem.tfw" else None)
    load(file)
    (tmp_path / name).write_text(text)
    with pytest.raises(TwinError, match=f"{name}' has coordinates or values of 'dem.tif'"):
        load(file)


def test_every_raster_is_opened_by_a_named_driver_and_every_image_from_checked_bytes():
    for file in [*ROOT.glob("twin/**/*.py"), *ROOT.glob("terrains/**/*.py")]:
        text = file.read_text()
        for call in re.findall(r"rasterio\.open\(.*", text):
            assert "driver=" in call or '"w"' in call, f"{file.name}: {call}"
        assert "cv2.imread(" not in text, file.name


NPY = b"\x93NUMPY\x01\x00v\x00"
BROKEN_NPY = {
    "zip": b"PK\x03\x04" + bytes(500),
    "header": NPY + b"{'descr': '<f8', 'fortran_order': False, 'shape': (3, (".ljust(117) + b"\n" + bytes(72),
    "empty": b"",
    "sizes": NPY + b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 10000000000)}".ljust(117) + b"\n",
}


@pytest.mark.parametrize("kind", BROKEN_NPY)
def test_a_broken_npy_header_is_one_error(tmp_path, kind):
    (tmp_path / "dem.npy").write_bytes(BROKEN_NPY[kind])
    with pytest.raises(TwinError, match=r"^terrain.height_file: 'dem.npy' cannot be read: [^\n]*$"):
        load(tmp_path / "dem.npy")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"values": np.where(HEIGHTS > -7.1, 1e30, HEIGHTS)}, "has the value 1e\\+30"),
        ({"values": np.full((35, 40), 2**32 - 9, np.uint32)}, "has a height of 4.29497e\\+09 m"),
        ({"transform": from_origin(0, 0, 1e-300, 1e-300)}, "has cells of 1e-300"),
        ({"transform": from_origin(np.nan, 0, 1, 1)}, "coordinates are not finite"),
        ({"transform": from_origin(1e300, 0, 1, 1)}, "has cells of 1 at"),
        ({"tiled": True, "blockxsize": 2**13, "blockysize": 2**12, "SPARSE_OK": True}, "larger than the raster"),
    ],
)
def test_implausible_grids_are_refused_before_an_array_is_made(tmp_path, change, problem):
    with pytest.raises(TwinError, match=problem):
        load(write_tif(tmp_path / "dem.tif", **change))


def test_a_map_with_more_cells_than_its_file_can_contain_is_refused(tmp_path):
    layout = {"driver": "GTiff", "width": 9000, "height": 9000, "count": 1, "dtype": "float64", "SPARSE_OK": True}
    with rasterio.open(tmp_path / "dem.tif", "w", **layout, tiled=True, transform=PLACED):
        pass
    with pytest.raises(TwinError, match="9000 x 9000 cells"):
        read_raster(tmp_path / "dem.tif")


@pytest.mark.parametrize(
    "name", ["/dev/zero", "/dev/stdin", "/", "/proc/self/mem", "none", "fifo", "loop", "a\0b", "n" * 999]
)
def test_what_is_no_regular_file_is_refused_by_every_reader(tmp_path, name):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "loop").symlink_to("loop")
    for reader in (read_bytes, read_text, read_json, read_yaml, read_raster, load):
        with pytest.raises(TwinError) as error:
            reader(tmp_path / name)
        assert "\n" not in str(error.value)


def test_a_file_is_not_read_beyond_its_limit(tmp_path):
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(TwinError, match="is too large: 1099511627776 bytes"):
        read_bytes(tmp_path / "large")


@pytest.mark.parametrize(
    "ring", ["[[1%s, 0], [1, 0], [1, 1], [1, 0]]" % ("0" * 500), "[" * 9000, "[1, 2, 3, 4]", '{"a": 1}']
)
def test_an_impossible_polygon_is_one_error(tmp_path, ring):
    (tmp_path / "area.json").write_text(f'{{"type": "Polygon", "coordinates": [{ring}]}}')
    floor = load(write_tif(tmp_path / "dem.tif"))
    with pytest.raises(TwinError, match=r"^plan.polygon: [^\n]*$"):
        read_area(tmp_path / "area.json", floor)


def test_a_scalar_matrix_of_opencv_is_one_error(tmp_path):
    for tag in ("matrix", "nd-matrix"):
        (tmp_path / "rig.yaml").write_text(f"%YAML:1.0\n---\nM1: !!opencv-{tag} 5\n")
        with pytest.raises(TwinError, match="is not valid YAML"):
            read_yaml(tmp_path / "rig.yaml")


def test_a_loop_of_links_among_compared_runs_is_one_error(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(TwinError, match="Too many levels of symbolic links"):
        load_runs([tmp_path / "a", tmp_path / "b"])


@pytest.mark.parametrize("kind", ["fifo", "link", "large"])
def test_the_crs_beside_a_grid_as_text_is_a_small_regular_file_or_refused(tmp_path, kind):
    """GDAL reads it as a whole, and would wait for a pipe."""
    (tmp_path / "dem.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n-1 -2\n-3 -4\n")
    assert load(tmp_path / "dem.asc").highest_m == 3.0
    if kind == "fifo":
        os.mkfifo(tmp_path / "dem.prj")
    elif kind == "link":
        (tmp_path / "dem.prj").symlink_to("/dev/zero")
    else:
        (tmp_path / "dem.prj").write_text(" " * 2**21)
    with pytest.raises(TwinError, match="'dem.prj' is not a regular file of at most 1048576 bytes"):
        load(tmp_path / "dem.asc")


@pytest.mark.parametrize("kind", ["fifo", "link", "loop", "parent"])
def test_what_a_mesh_names_is_a_regular_file_in_its_folder_or_refused(tmp_path, kind):
    mesh, named = tmp_path / "mesh" / "a.obj", tmp_path / "mesh" / "a.mtl"
    mesh.parent.mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 0 0\n")
    mesh.write_text(f"mtllib {'../secret' if kind == 'parent' else 'a'}.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    if kind == "fifo":
        os.mkfifo(named)
    elif kind != "parent":
        named.symlink_to({"link": "/dev/zero", "loop": "a.mtl"}[kind])
    with pytest.raises(TwinError, match="needs the file .*, which is not beside it or cannot be read"):
        read_mesh(mesh, "terrain.mesh_file", (0.5, 0.5, 0.5))


def test_an_accessor_without_data_is_refused_by_its_size(tmp_path):
    file = tmp_path / "mesh.glb"
    trimesh.creation.box().export(file)
    data = file.read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    tree["accessors"][0]["count"], tree["accessors"][1]["count"] = 36, 10**9
    text = json.dumps(tree).encode()
    file.write_bytes(data[:12] + len(text).to_bytes(4, "little") + data[16:20] + text)
    with pytest.raises(TwinError, match="1000000000 elements of an accessor"):
        read_mesh(file, "terrain.mesh_file", (0.5, 0.5, 0.5))


SYSTEM = ("/proc/self/", "/dev/null", sys.prefix, sys.base_prefix, str(ROOT / "twin"), str(ROOT / "terrains"))


def samples(folder):
    """Returns a valid file of each kind with its reader."""
    rng = np.random.default_rng(1)
    dem = write_tif(folder / "dem.tif", compress="deflate", tags={"title": "floor"})
    floor = load(dem)
    np.save(folder / "dem.npy", HEIGHTS)
    photo = write_tif(
        folder / "photo.tif", rng.integers(0, 255, (70, 80, 3), np.uint8), from_origin(5e5, 8e6, 0.25, 0.25)
    )
    rasterio.shutil.copy(photo, folder / "photo.png", driver="PNG")
    corners = [[500002.0, 7999998.0], [500008.0, 7999998.0], [500008.0, 7999990.0], [500002.0, 7999998.0]]
    (folder / "area.json").write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    kml_corners = " ".join(
        f"{145 + 1e-6 * east:.9f},{-18 + 1e-6 * north:.9f},0" for east, north in np.array(corners) % 10
    )
    (folder / "area.kml").write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>'
        f"{kml_corners}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    survey = {"complexItemType": "survey", "polygon": [[-18.0, 145.0], [-18.0, 145.1], [-18.1, 145.1]]}
    (folder / "area.plan").write_text(json.dumps({"mission": {"items": [{"type": "SimpleItem"}, survey]}}))
    for name, driver, kind in (
        ("dem.asc", "AAIGrid", np.float32),
        ("dem.xyz", "XYZ", np.float32),
        ("h.png", "PNG", np.uint16),
    ):
        values = HEIGHTS.astype(np.float32) if kind is np.float32 else (HEIGHTS + 9) * 1000
        rasterio.shutil.copy(write_tif(folder / "copied.tif", values.astype(kind)), folder / name, driver=driver)
    (folder / "h.png.aux.xml").unlink(missing_ok=True)
    (folder / "named.obj").write_text(
        "mtllib named.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n" + "f 1/1 2/2 3/3\n"
    )
    (folder / "named.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd photo.png\n")
    (folder / "rig.yaml").write_text(
        "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [1., 2.]\nT: &a {x: 1}\n"
    )
    (folder / "scene.toml").write_text('extends = "reef"\nseed = 7\n[plan]\ntracks = 2\narea_m = [2.0, 1.0]\n')
    box = trimesh.creation.icosphere(1)
    for suffix in ("ply", "obj", "glb"):
        box.export(folder / f"mesh.{suffix}")
    mesh = lambda file: read_mesh(file, "terrain.mesh_file", (0.5, 0.5, 0.5))  # noqa: E731
    return {
        dem: load, folder / "dem.npy": load, photo: lambda file: load(dem, orthophoto_file=file),
        folder / "photo.png": lambda file: load(dem, photo_file=file),
        **{folder / f"area.{suffix}": lambda file: read_area(file, floor) for suffix in ("json", "kml", "plan")},
        **{folder / name: load for name in ("dem.asc", "dem.xyz", "h.png")},
        folder / "named.mtl": lambda file: mesh(file.with_suffix(".obj")),
        folder / "rig.yaml": read_yaml, folder / "scene.toml": load_scenario,
        **{folder / f"mesh.{suffix}": mesh for suffix in ("ply", "obj", "glb")},
    }  # fmt: skip


def damaged(data, rng):
    """Returns bytes with some of them changed, cut out, repeated or cut off."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at, n = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 9))
        kind = rng.integers(0, 5)
        new = rng.integers(0, 256, n, np.uint8).tobytes() if kind else data[at : at + 50 * n] * 2
        data[at : at + (n if kind > 1 else 0)] = new if kind != 2 else b""
    return bytes(data[: rng.integers(0, len(data) + 1)] if rng.random() < 0.1 else data)


def _stay_inside(folder, event, values):
    """Ends the process if Python opens a file outside the folder, or a socket."""
    outside = event == "open" and isinstance(values[0], str) and not Path(values[0]).is_relative_to(folder)
    if event in ("socket.connect", "subprocess.Popen", "os.system") or (outside and not values[0].startswith(SYSTEM)):
        sys.stderr.write(f"{event} {values}\n")
        os._exit(3)


def fuzz(folder, n, seed):
    """Reads `n` damaged copies of each sample; only TwinError may come out, and no other file may be opened."""
    rng, read_files = np.random.default_rng(seed), samples(folder)
    for file, reader in read_files.items():
        if file.name not in ("area.kml", "area.plan"):  # the DEM of the samples names no CRS
            reader(file)  # loads the modules and the tables that it needs
    sys.addaudithook(functools.partial(_stay_inside, folder))
    for file, reader in read_files.items():
        data = file.read_bytes()
        for _ in range(n):
            file.write_bytes(damaged(data, rng))
            try:
                reader(file)
            except TwinError as error:
                assert str(error)
            except BaseException as error:
                Path(f"{file}.failed").write_bytes(file.read_bytes())
                raise AssertionError(f"{file}.failed: {error!r}") from error
        file.write_bytes(data)


@pytest.mark.long
def test_only_twin_errors_come_out_of_damaged_files(tmp_path):
    # 2000 files in a process of its own, which measures its memory
    code = f"import test_user_files as t, pathlib; t.fuzz(pathlib.Path({str(tmp_path)!r}), 125, 3); t.report_memory()"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.splitlines()[-1]) < 1_000_000  # kB


def report_memory():
    """Prints the largest memory of this program [kB]; `ru_maxrss` would include that of the process that started it."""
    print(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1])


def test_links_to_themselves_and_to_missing_files_are_problems_and_new_paths_are_not(tmp_path):
    loop, dangling = tmp_path / "loop", tmp_path / "dangling"
    loop.symlink_to("loop")
    dangling.symlink_to("nothing")
    for path in (loop, loop / "run"):
        assert "symbolic links" in (path_problem(path) or "")
    assert "missing file" in (path_problem(dangling) or "")
    for path in (tmp_path, tmp_path / "new" / "run"):
        assert path_problem(path) is None


@pytest.mark.parametrize(("name", "reason"), [("a\0b", "null byte"), ("x" * 300, "too long")])
def test_an_invalid_name_is_a_problem(tmp_path, name, reason):
    assert reason in (path_problem(tmp_path / name) or "")
