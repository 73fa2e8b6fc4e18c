"""Models of the built-in shapes, kept on disk from run to run: to build those of a reef takes seconds."""

import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import numpy as np

from twin.kernels import cache_folder
from twin.terrains.objects.placed_object import ObjectModel, model_of
from twin.terrains.objects.shapes import SHAPES, build_shape

_MOST_KEPT = 96  #: models; those written first are removed


def built_model(
    shape: str, albedo: tuple[float, float, float] | None, seed: np.random.SeedSequence, **form: float
) -> ObjectModel:
    """Returns the model of a built-in shape (`shapes.build_shape`), read from disk if it was built before."""
    key = repr((np.__version__, shape, albedo, seed.entropy, seed.spawn_key, sorted(form.items())))

    def build() -> ObjectModel:
        return model_of(build_shape(shape, albedo, np.random.default_rng(seed), **form), SHAPES[shape].sways)

    folder = cache_folder(Path(__file__).resolve(), __name__)
    return build() if folder is None else _kept(folder / f"{sha256(key.encode()).hexdigest()[:32]}.pickle", build)


def _kept(file: Path, build: Callable[[], ObjectModel]) -> ObjectModel:
    """Returns the object in a file; builds and writes it if there is none, or if it is damaged."""
    with suppress(OSError, EOFError, ValueError, pickle.UnpicklingError):
        return pickle.loads(file.read_bytes())
    model, part = build(), file.with_suffix(f".{os.getpid()}.part")
    with suppress(OSError):  # of a full disk
        part.write_bytes(pickle.dumps(model, pickle.HIGHEST_PROTOCOL))
        part.replace(file)
        for old in sorted(file.parent.glob("*.pickle"), key=lambda kept: kept.stat().st_mtime)[:-_MOST_KEPT]:
            old.unlink()
    return model
