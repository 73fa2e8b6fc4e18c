"""Names, citations and water types of the published tables of absorption and scattering in the package `jerlov`."""

from typing import Literal, NamedTuple

WaterSourceName = Literal["solonenko2015", "williamson2022"]


class WaterSource(NamedTuple):
    """A published table of water types."""

    citation: str  # authors and year
    types: tuple[str, ...]  # the Jerlov types of the table


WATER_SOURCES: dict[WaterSourceName, WaterSource] = {
    "solonenko2015": WaterSource(
        "Solonenko & Mobley 2015", ("I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C")
    ),
    "williamson2022": WaterSource("Williamson & Hollins 2022", ("IB", "II", "III", "1C", "3C", "5C")),
}
