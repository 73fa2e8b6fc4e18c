"""Exact truth of recorded images as image files: depth, flow, normals, albedo, light, labels."""

import json
from pathlib import Path

import cv2
import numpy as np

from twin.datasets.run_contents import RunContents
from twin.exports.true_layers import FrameTruth, true_layers
from twin.report.run_folder import SCENARIO_FILE
from twin.scenario.file import load_scenario

_MOST_MM = 65535  # largest value of a 16-bit PNG


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the true layers of all recorded left images, one subfolder per layer, and index.json.

    The files are named by the numbers of the frames; `FrameTruth` defines the layers. `depth` and the layers of the
    light are 32-bit TIFF, `depth_mm` is a 16-bit PNG in millimetres (0: no surface, or farther than 65.5 m), `flow` is
    a Middlebury .flo file, `normals` is a 32-bit TIFF with x, y, z in its channels R, G, B, `albedo` and `clean` are
    8-bit PNG, and `labels` is a 16-bit PNG. `index.json` has the camera matrix, the names of the objects, and for each
    frame the difference between the recorded image and the image rendered again. Raises TwinError as `true_layers`
    does.
    """
    scenario = load_scenario(contents.folder / SCENARIO_FILE, allow_plugins=contents.allow_plugins)
    names, layers = true_layers(contents.folder, scenario, contents.frames)
    frames = []
    for k, truth in enumerate(layers):
        _write(truth, folder)
        difference = {"rms_difference": round(truth.difference, 4), "identical": truth.identical}
        frames.append({"index": truth.frame.index, "time_s": truth.frame.time_s, **difference})
        contents.progress((k + 1) / len(contents.frames))
    compared = [frame["identical"] for frame in frames if frame["identical"] is not None]
    tree = {
        "camera_matrix": contents.rig.matrix.tolist(),
        "objects": {str(k + 1): name for k, name in enumerate(names)},
        "rerendered": {
            "compared_with_noise": len(compared),
            "identical": sum(compared),
            "largest_rms_difference": max((frame["rms_difference"] for frame in frames), default=0.0),
        },
        "frames": frames,
    }
    index = folder / "index.json"
    index.write_text(json.dumps(tree, indent=1), encoding="utf-8")
    return [folder, index]


def _write(truth: FrameTruth, folder: Path) -> None:
    number = f"{truth.frame.index:06d}"
    millimetres = np.where(truth.depth_m * 1000 < _MOST_MM, np.round(truth.depth_m * 1000), 0).astype(np.uint16)
    files = {
        f"depth/{number}.tiff": truth.depth_m,
        f"depth_mm/{number}.png": millimetres,
        f"normals/{number}.tiff": truth.normals[..., ::-1],
        f"albedo/{number}.png": truth.albedo[..., ::-1],
        f"clean/{number}.png": truth.clean[..., ::-1],
        f"labels/{number}.png": truth.labels,
    }
    files |= {f"{name}/{number}.tiff": layer[..., ::-1] for name, layer in truth.light.items()}
    if truth.flow_px is not None:
        files[f"flow/{number}.flo"] = truth.flow_px
    for name, values in files.items():
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        write = cv2.writeOpticalFlow if file.suffix == ".flo" else cv2.imwrite
        if not write(str(file), np.ascontiguousarray(values)):
            raise OSError(f"{file} cannot be written")
