"""The measured motions of the keyframe network, one by one and by columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.growing_array import Rows


class Link(NamedTuple):
    """One connection of the keyframe network: the measured motion between two nodes.

    Args:
        i, j: keyframe numbers, i < j.
        i_from_j: (4, 4) pose of camera j in camera i.
        cov: (6, 6) covariance of [rotation, translation] in j (rad, m).
        overlap: share of image j that is seen in image i (0 to 1).
        n_points: matched points used; 0 where frame-to-frame motion stands in.
        shared_by: links of node j that rest on its one stereo look: `cov` is that of this motion alone, so many times.
        closed_form: (4, 4) the same motion by eq. (2), depth taken as exact; None without.
    """

    i: int
    j: int
    i_from_j: Array
    cov: Array
    overlap: float
    n_points: int
    shared_by: int = 1
    closed_form: Array | None = None

    @property
    def own_cov(self) -> Array:
        """(6, 6) covariance of this motion alone, beside no other link of its node."""
        return self.cov / self.shared_by


_LINK = np.dtype(
    [
        ("i", int), ("j", int), ("i_from_j", float, (4, 4)), ("information", float, (6, 6)), ("overlap", float),
        ("n_points", int), ("shared_by", int),
    ]
)  # fmt: skip


class Links(Sequence[Link]):
    """Many links by columns, as arrays; one by one where speed does not matter."""

    def __init__(self, links: Iterable[Link] = ()):
        self._rows = Rows(kind=_LINK)
        self._closed_forms: list[Array | None] = []
        self._new = list(links)  # not among the rows yet

    @classmethod
    def of(cls, links: Sequence[Link]) -> Links:
        """These by columns."""
        return links if isinstance(links, cls) else cls(links)

    def add(self, links: Iterable[Link]) -> None:
        """Appends."""
        self._new += links

    def kept(self, mask: NDArray[np.bool_]) -> Links:
        """Those of a mask (n,); these themselves where all are."""
        if mask.all():
            return self
        kept = Links()
        kept._rows = Rows.of(self._table[mask])
        kept._closed_forms = [form for form, stays in zip(self._closed_forms, mask.tolist(), strict=True) if stays]
        return kept

    def __len__(self) -> int:
        return len(self._rows) + len(self._new)

    @overload
    def __getitem__(self, k: int) -> Link: ...

    @overload
    def __getitem__(self, k: slice) -> list[Link]: ...

    def __getitem__(self, k: int | slice) -> Link | list[Link]:
        if isinstance(k, slice):
            return [self[at] for at in range(*k.indices(len(self)))]
        i, j, i_from_j, information, overlap, n_points, shared_by = self._table[k]
        numbers = float(overlap), int(n_points), int(shared_by)
        return Link(int(i), int(j), i_from_j, inverses(information[None])[0], *numbers, self._closed_forms[k])

    @property
    def i(self) -> NDArray[np.int64]:
        """(n,) numbers of the earlier keyframes."""
        return self._table["i"]

    @property
    def j(self) -> NDArray[np.int64]:
        """(n,) numbers of the later ones."""
        return self._table["j"]

    @property
    def i_from_j(self) -> Array:
        """(n, 4, 4) motions."""
        return self._table["i_from_j"]

    @property
    def cov(self) -> Array:
        """(n, 6, 6) their covariances."""
        return inverses(self.information)

    @property
    def own_cov(self) -> Array:
        """(n, 6, 6) those of each alone."""
        return self.cov / self._table["shared_by"][:, None, None]

    @property
    def information(self) -> Array:
        """(n, 6, 6) inverse covariances, which is what is kept."""
        return self._table["information"]

    @property
    def n_points(self) -> NDArray[np.int64]:
        """(n,) matched points; 0 where frame-to-frame motion stands in."""
        return self._table["n_points"]

    @property
    def by_closed_form(self) -> tuple[NDArray[np.bool_], Array]:
        """Which links (n,) have a closed form, and theirs (m, 4, 4)."""
        self._settle()
        found = [form for form in self._closed_forms if form is not None]
        return np.array([form is not None for form in self._closed_forms], bool), np.array(found).reshape(-1, 4, 4)

    @property
    def _table(self) -> NDArray[Any]:
        self._settle()
        return self._rows.array

    def _settle(self) -> None:
        """Gives new ones their rows, many at a time."""
        if self._new:
            new, self._new = self._new, []
            *columns, closed_forms = zip(*new, strict=True)
            table = np.empty(len(new), _LINK)
            for name, column in zip(_LINK.names or (), columns, strict=True):
                table[name] = inverses(np.array(column)) if name == "information" else column
            self._rows.add(table)
            self._closed_forms += closed_forms


def inverses(covs: Array) -> Array:
    """Information of covariances (m, d, d), or the other way round; symmetric to the last bit."""
    found = np.asarray(np.linalg.inv(covs), np.float64)
    found = found + found.transpose(0, 2, 1)
    found /= 2
    return found
