"""Measured motions between nodes of the keyframe network: a single link, and a sequence of links as arrays."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.series import GrowingArray


class Link(NamedTuple):
    """Measured motion between two nodes of the keyframe network."""

    #: i, j: keyframe numbers, i < j.
    i: int
    j: int
    i_from_j: Array  #: (4, 4) pose of camera j in camera i
    cov: Array  #: (6, 6) covariance of [rotation, translation] (rad, m) in camera j, as used by the alignment
    overlap: float  #: fraction of the matched points of node j that project into image i (0 to 1)
    n_points: int  #: matched points used; 0 for frame-to-frame motion that replaces a failed measurement
    #: effective number of links that share the errors of this one: those that share the stereo observation of node j,
    #: times the factor for errors of the floor (`link_selection.inflate_for_shared_noise`). `cov` is the covariance of
    #: the single measurement times this number.
    shared_by: float = 1.0
    #: (4, 4) motion from the closed form (Negahdaripour & Madjidi 2003, eq. 2), with exact depth; None: not computed.
    closed_form: Array | None = None
    #: (6,) change of the measured motion, in the axes of camera j, per yaw between the cameras (rad, m per rad); None:
    #: not known, as for motion that replaces a failed measurement.
    by_yaw: Array | None = None
    yaw_rad: float = 0.0  #: yaw for which the measured motion is already corrected
    by_image_errors: Array | None = None  #: (6, 18) see `Motion`; None: not known
    #: fraction (0 to 1) of the variance that image noise does not explain: it is due to the relief within the matched
    #: patches, and correlated between links that use the same patches. `Links` does not store it.
    floor_share: float = 0.0

    @property
    def own_cov(self) -> Array:
        """Returns the covariance (6, 6) of the single measurement."""
        return self.cov / self.shared_by


_LINK = np.dtype(
    [
        ("i", int), ("j", int), ("i_from_j", float, (4, 4)), ("information", float, (6, 6)), ("overlap", float),
        ("n_points", int), ("shared_by", float), ("closed_form", np.float32, (4, 4)), ("by_yaw", float, (6,)),
        ("yaw_rad", float), ("by_image_errors", np.float32, (6, 18)),
    ]
)  # fmt: skip
_NOT_COMPUTED = np.full((4, 4), np.nan)


def _column(name: str) -> Any:
    def values(links: "Links") -> NDArray[Any]:
        return links.table[name]

    return property(values)


class Links(Sequence[Link]):
    """Sequence of links stored as a structured array, for vectorised access to the fields of all links (n, ...)."""

    i: NDArray[np.int64] = _column("i")
    j: NDArray[np.int64] = _column("j")
    i_from_j: Array = _column("i_from_j")
    information: Array = _column("information")
    n_points: NDArray[np.int64] = _column("n_points")
    shared_by: Array = _column("shared_by")
    by_yaw: Array = _column("by_yaw")  #: zeros where it is not known
    yaw_rad: Array = _column("yaw_rad")
    by_image_errors: NDArray[np.float32] = _column("by_image_errors")  #: zeros where it is not known

    def __init__(self, links: Iterable[Link] = ()):
        self._rows = GrowingArray(dtype=_LINK)
        self._pending = list(links)  # added, but not yet converted to rows

    @classmethod
    def from_sequence(cls, links: Sequence[Link]) -> "Links":
        return links if isinstance(links, cls) else cls(links)

    def add(self, links: Iterable[Link]) -> None:
        self._pending += links

    def select(self, mask: NDArray[np.bool_]) -> "Links":
        """Returns the links where the mask (n,) is true; this object itself if it is true for all."""
        if mask.all():
            return self
        selected = Links()
        selected._rows = GrowingArray.wrap(self.table[mask])
        return selected

    def __len__(self) -> int:
        return len(self._rows) + len(self._pending)

    @overload
    def __getitem__(self, k: int) -> Link: ...

    @overload
    def __getitem__(self, k: slice) -> list[Link]: ...

    def __getitem__(self, k: int | slice) -> Link | list[Link]:
        if isinstance(k, slice):
            return [self[index] for index in range(*k.indices(len(self)))]
        i, j, i_from_j, information, overlap, n_points, shared_by, form, by_yaw, yaw_rad, by_errors = self.table[k]
        numbers = float(overlap), int(n_points), float(shared_by)
        cov = symmetric_inverses(information[None])[0]
        form = None if np.isnan(form[0, 0]) else form.astype(np.float64)
        return Link(int(i), int(j), i_from_j, cov, *numbers, form, by_yaw, float(yaw_rad), by_errors)

    @property
    def cov(self) -> Array:
        return symmetric_inverses(self.information)

    @property
    def own_cov(self) -> Array:
        return self.cov / self.shared_by[:, None, None]

    @property
    def by_closed_form(self) -> tuple[NDArray[np.bool_], Array]:
        """Returns the mask (n,) of the links that have a closed-form motion, and these motions (m, 4, 4)."""
        forms = self.table["closed_form"]
        known = ~np.isnan(forms[:, 0, 0])
        return known, forms[known].astype(np.float64)

    @property
    def table(self) -> NDArray[Any]:
        if self._pending:
            pending, self._pending = self._pending, []
            *columns, closed_forms, by_yaw, yaw_rad, by_image_errors, _ = zip(*pending, strict=True)
            table = np.empty(len(pending), _LINK)
            for name, column in zip(_LINK.names or (), columns, strict=False):
                table[name] = symmetric_inverses(np.array(column)) if name == "information" else column
            table["closed_form"] = [_NOT_COMPUTED if form is None else form for form in closed_forms]
            table["by_yaw"] = [np.zeros(6) if derivative is None else derivative for derivative in by_yaw]
            table["yaw_rad"] = yaw_rad
            table["by_image_errors"] = [np.zeros((6, 18)) if one is None else one for one in by_image_errors]
            self._rows.append(table)
        return self._rows.array


def symmetric_inverses(matrices: Array) -> Array:
    """Returns the inverses (m, d, d), exactly symmetric, of symmetric matrices (m, d, d)."""
    inverse = np.asarray(np.linalg.inv(matrices), np.float64)
    inverse = inverse + inverse.transpose(0, 2, 1)
    inverse /= 2
    return inverse
