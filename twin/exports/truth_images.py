"""Exact truth of recorded images as image files: depth, flow, normals, albedo, light, labels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from twin.datasets.run_contents import FrameTruth, RunContents

_MOST_MM = 65535  # largest value of a 16-bit PNG


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the true layers of all recorded left images, one subfolder per layer, and index.json.

    The files are named by the numbers of the frames; `FrameTruth` defines the layers. `depth` and the layers of the
    light are 32-bit TIFF, `depth_mm` is a 16-bit PNG in millimetres (0: no surface, or farther than 65.5 m), `flow` is
    a Middlebury .flo file, `normals` is a 32-bit TIFF with x, y, z in its channels R, G, B, `albedo` and `clean` are
    8-bit PNG, and `labels` is a 16-bit PNG. `index.json` has the camera matrix, the names of the objects, and for each
    frame the difference between the recorded image and the image rendered again.

    Returns:
        `folder` and the path of index.json.

    Raises:
        TwinError: the true poses are damaged, the scenario can no longer be prepared, or an image cannot be read.
        OSError: a file cannot be written.
    """
    assert contents.true_layers is not None
    layers = contents.true_layers()
    frames = []
    for k, truth in enumerate(layers.frames):
        _write(truth, folder)
        frames.append(
            {
                "index": truth.frame.index,
                "time_s": truth.frame.time_s,
                "rms_difference": round(truth.difference, 4),
                "identical": truth.identical,
            }
        )
        contents.progress((k + 1) / len(contents.frames))
    compared = [frame["identical"] for frame in frames if frame["identical"] is not None]
    contents_of_index = {
        "camera_matrix": contents.rig.matrix.tolist(),
        "objects": {str(k + 1): name for k, name in enumerate(layers.object_names)},
        "rerendered": {
            "compared_with_noise": len(compared),
            "identical": sum(compared),
            "largest_rms_difference": max((frame["rms_difference"] for frame in frames), default=0.0),
        },
        "frames": frames,
    }
    index = folder / "index.json"
    index.write_text(json.dumps(contents_of_index, indent=1), encoding="utf-8")
    return [folder, index]


def _write(truth: FrameTruth, folder: Path) -> None:
    """Writes the layers of one frame; raises OSError if a file cannot be written."""
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
