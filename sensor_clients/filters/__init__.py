"""Local trackers, batched over tracks (the batch axis is the last)."""

from sensor_clients.filters.association import Association, associate, likelihood, update
from sensor_clients.filters.bearing import Bearing, BearingTracker
from sensor_clients.filters.gmphd import GmPhdFilter, PhdConfig
from sensor_clients.filters.imm import ImmTracker, Modes
from sensor_clients.filters.measurement import (
    STATE,
    MeasurementModel,
    Position,
    Prediction,
    RangeAzimuth,
    predict_measurement,
)
from sensor_clients.filters.tracker import LocalTracker, Report, TrackerConfig

__all__ = [
    "STATE",
    "Association",
    "Bearing",
    "BearingTracker",
    "GmPhdFilter",
    "ImmTracker",
    "LocalTracker",
    "MeasurementModel",
    "Modes",
    "PhdConfig",
    "Position",
    "Prediction",
    "RangeAzimuth",
    "Report",
    "TrackerConfig",
    "associate",
    "likelihood",
    "predict_measurement",
    "update",
]
