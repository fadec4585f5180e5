"""Degrees on the WGS 84 ellipsoid to metres in a touching plane, and back. No ROS in here."""

from __future__ import annotations

import math

SEMI_MAJOR_M = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3


class LocalFrame:
    """Metres east and north of a datum. Good to a centimetre within some kilometres of it."""

    def __init__(self, latitude: float, longitude: float) -> None:
        """``latitude`` and ``longitude`` of the datum in degrees.

        :raises ValueError: a datum that is not on the Earth, or within a degree of a pole.
        """
        if not (abs(latitude) <= 89 and abs(longitude) <= 180):
            raise ValueError(
                f"the datum must have a latitude within ±89° and a longitude within ±180°, "
                f"is {latitude}, {longitude}"
            )
        self.latitude = latitude
        self.longitude = longitude
        phi = math.radians(latitude)
        flattening = 1 - ECCENTRICITY_SQUARED * math.sin(phi) ** 2
        prime_vertical_m = SEMI_MAJOR_M / math.sqrt(flattening)
        meridian_m = prime_vertical_m * (1 - ECCENTRICITY_SQUARED) / flattening
        self._east_m_per_degree = math.radians(1) * prime_vertical_m * math.cos(phi)
        self._north_m_per_degree = math.radians(1) * meridian_m

    def to_metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return (east, north) in metres of a position in degrees."""
        east_degrees = math.remainder(longitude - self.longitude, 360.0)
        north_degrees = latitude - self.latitude
        return east_degrees * self._east_m_per_degree, north_degrees * self._north_m_per_degree

    def to_degrees(self, east: float, north: float) -> tuple[float, float]:
        """Return (latitude, longitude) in degrees of a position in metres."""
        longitude = math.remainder(self.longitude + east / self._east_m_per_degree, 360.0)
        return self.latitude + north / self._north_m_per_degree, longitude
