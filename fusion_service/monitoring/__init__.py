"""What monitoring systems ask of a process: Prometheus metrics, and over the same port whether it is alive and ready.

`figures` says what of a status is a metric, `health` whether all goes well, `server` serves it. The client library of
Prometheus comes with the extra `metrics`, and is imported when something is served.
"""

from fusion_service.monitoring.figures import METRICS, Metric, Sample, recorder_samples, status_samples
from fusion_service.monitoring.health import Heard, Links, Pulse, Recorded
from fusion_service.monitoring.server import DEFAULT_HOST, Serving, process_samples, served

__all__ = [
    "DEFAULT_HOST",
    "METRICS",
    "Heard",
    "Links",
    "Metric",
    "Pulse",
    "Recorded",
    "Sample",
    "Serving",
    "process_samples",
    "recorder_samples",
    "served",
    "status_samples",
]
